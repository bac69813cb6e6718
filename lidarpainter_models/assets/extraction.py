"""Take assets out of a fitted scene: actors, blocks of street, the sky, the ways driven.

Each is written into a folder of its own, in its own frame (actors: that of their box) and in
neutral exposure: multiplied so that the road where it was recorded is of one grey.
"""

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.asset_files import write_asset
from lidarpainter_models.assets.completion import WholeActor
from lidarpainter_models.assets.expected_quality import (
    directions,
    evidence_of,
    expected_psnr_db,
    score_of,
)
from lidarpainter_models.assets.seen_surfaces import SeenSurface
from lidarpainter_models.assets.sightings import Sighting
from lidarpainter_models.assets.street_blocks import street_blocks
from lidarpainter_models.assets.whole_actors import LEAST_GAUSSIANS, whole_actor
from lidarpainter_models.editing.actor_models import (
    NEUTRAL_ROAD_RGB,
    ActorModel,
    exposed,
    exposure_gain,
)
from lidarpainter_models.editing.worlds import EditedWorld, as_moving
from lidarpainter_models.errors import SceneError
from lidarpainter_models.export.images import write_webp
from lidarpainter_models.gaussians.model.drawing import draw_gaussians
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.actor_names import path_of_track
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.storage.tensor_files import write_tensors

THUMBNAIL_FILE = "turntable.webp"
SKY_FILE, WAYPOINTS_FILE = "sky.safetensors", "waypoints.csv"
SKY_ROWS = 96
"""Rows of a sky's picture."""
NUM_AZIMUTHS = 8
"""Pictures of an asset on its turntable, side by side before plain grey."""
WIDTH_PX, HEIGHT_PX = 128, 96
BACKGROUND = 0.75
_FOCAL_PX = 1.6 * WIDTH_PX

Record = dict[str, Any]
"""What is known of one asset; its names are those of the catalog's table `sightings`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AssetSource:
    """What the assets of a run are taken from."""

    world: EditedWorld
    """Its Gaussians as they are shown, in a style if the run is in one."""
    sighted: Mapping[str, Sighting]
    """How well each actor was seen, by id."""
    surfaces: Mapping[str, SeenSurface] = field(default_factory=dict)
    """Surfaces of the vehicles, by id."""
    judged_on: str
    """Which images their errors are of."""
    global_from_world: Float[Tensor, "4 4"]

    @property
    def gain(self) -> Float[Tensor, "3"]:
        """What colours are multiplied by to go from the exposure of the scene to a neutral one."""
        road_rgb = self.world.road_rgb
        if road_rgb is None:
            return torch.ones(3)
        return exposure_gain(road_rgb, torch.tensor(NEUTRAL_ROAD_RGB))


def write_assets(source: AssetSource, output: Path) -> list[Record]:
    """Write every asset into a folder below `output`, and say what each is.

    Raises:
        WriteError: the disk refuses.
    """
    records = [
        *_actors(source, output),
        *_street(source, output),
        _sky(source, output),
        *_trajectories(source, output),
    ]
    for record in records:
        placed = source.global_from_world @ record.pop("world_from_asset")
        record |= dict(zip(("x_m", "y_m", "z_m"), placed[:3, 3].tolist(), strict=True))
        record["heading_rad"] = math.atan2(float(placed[1, 0]), float(placed[0, 0]))
        files = (path for path in (output / record["folder"]).rglob("*") if path.is_file())
        record["num_bytes"] = sum(path.stat().st_size for path in files)
    return records


def _actors(source: AssetSource, output: Path) -> Iterator[Record]:
    """Whoever was seen well enough to have a score, in the order of the tracks."""
    for number, track in enumerate(source.world.tracks):
        seen = source.sighted[track.actor_id]
        if not seen.near_looks:
            continue
        try:
            found = source.world.model_of(track)
        except SceneError:
            continue  # nothing of it was fitted
        if len(found.gaussians) < LEAST_GAUSSIANS:
            continue
        whole = whole_actor(found, source.surfaces.get(track.actor_id))
        if len(whole.model.gaussians) < LEAST_GAUSSIANS:
            continue  # what was fitted lies outside its box
        model = whole.model.exposed_like(torch.tensor(NEUTRAL_ROAD_RGB))
        folder = f"actors/{number:03d}"
        shares = {f"{name}_share": share for name, share in whole.shares.items()}
        measured = _measured(seen, source.judged_on) | shares
        expected = _expected(whole, seen)
        measured["score"] = expected.get("score", seen.score)
        looks = [[one.azimuth_deg, one.elevation_deg, one.distance_m] for one in seen.near_looks]
        about = {**expected, **measured, "looks": looks}
        write_asset(output / folder, model, about, origin=whole.origin)
        yield {
            "kind": "actor",
            "category": track.category,
            "name": f"{track.category} {track.actor_id[:8]}",
            "actor_id": track.actor_id,
            "is_moving": track.is_moving,
            **_sized(model),
            **measured,
            **_when(track, source.world),
            "folder": folder,
            "thumbnail": _turned(output, folder, model, elevation_deg=15.0),
            "world_from_asset": as_moving(track, source.world.log).world_from_box[0].double(),
        }


def _expected(whole: WholeActor, seen: Sighting) -> Record:
    """Of a vehicle that was made whole, how right it is expected to look; else nothing."""
    if whole.surface is None:
        return {}
    evidence = evidence_of(whole, seen)
    psnr_db = expected_psnr_db(evidence)
    return {
        "score": score_of(psnr_db),
        "directions_deg": torch.rad2deg(directions()).tolist(),
        "expected_psnr_db": psnr_db.tolist(),
        "evidence": evidence.tolist(),
    }


def _measured(seen: Sighting, judged_on: str) -> Record:
    """The numbers of a sighting, as the catalog calls them."""
    distances_m = torch.tensor([look.distance_m for look in seen.near_looks])
    return {
        "num_views": len(seen.near_looks),
        "nearest_m": float(distances_m.min()),
        "median_m": float(distances_m.median()),
        "pixels_per_m": seen.pixels_per_m,
        "sides": seen.sides,
        "coverage": seen.coverage,
        "sharpness": seen.sharpness,
        "psnr_db": seen.psnr_db,
        "judged_on": None if seen.psnr_db is None else judged_on,
        "occlusion": seen.occlusion,
        "score": seen.score,
    }


def _street(source: AssetSource, output: Path) -> Iterator[Record]:
    """The street without moving and parked actors, in blocks."""
    world, gaussians = source.world, source.world.scene.gaussians
    is_street = gaussians.body_index == 0
    for track in world.parked:
        is_street[world.rows_of(track)] = False
    street = gaussians.select(is_street.nonzero()[:, 0])
    for block in street_blocks(street, world.log.ego):
        model = ActorModel(
            gaussians=exposed(block.gaussians, source.gain),
            points=MapPoints.concatenate([]),
            size_m=block.size_m,
            category="street",
        )
        folder = f"street/{block.number:+03d}"
        write_asset(output / folder, model, {})
        yield {
            "kind": "street",
            "category": "street",
            "name": f"street {block.number:+d}",
            **_sized(model),
            **_when(None, source.world),
            "folder": folder,
            "thumbnail": _turned(output, folder, model, elevation_deg=35.0),
            "world_from_asset": block.world_from_block,
        }


def _sky(source: AssetSource, output: Path) -> Record:
    """The sky's texture, with how its texels lie and how much each was seen."""
    sky = source.world.scene.sky.to(torch.device("cpu"))
    rgb = (sky.rgb * source.gain).clamp(0, 1)
    folder = "sky"
    (output / folder).mkdir()
    write_tensors(
        output / folder / SKY_FILE, {"rgb": rgb, "weight": sky.weight}, asdict(sky.layout)
    )
    step = max(1, math.ceil(len(rgb) / SKY_ROWS))
    thumbnail = f"{folder}/{THUMBNAIL_FILE}"
    write_webp(rgb[::step, ::step], output / thumbnail)
    return {
        "kind": "sky",
        "category": "sky",
        "name": "sky",
        "coverage": float((sky.weight > 0).float().mean()),
        **_when(None, source.world),
        "folder": folder,
        "thumbnail": thumbnail,
        "world_from_asset": source.world.log.ego.world_from_body[0],
    }


def _trajectories(source: AssetSource, output: Path) -> Iterator[Record]:
    """The ways of the ego and of whoever moved, as waypoints from where each began."""
    world = source.world
    yield _trajectory(output, 0, "ego", world.log.ego) | _when(None, world)
    for number, track in enumerate(world.moving, start=1):
        if len(track.timestamps_ns) < 2:
            continue
        found = _trajectory(output, number, track.category, path_of_track(track))
        yield found | {"actor_id": track.actor_id, "is_moving": True} | _when(track, world)


def _trajectory(output: Path, number: int, category: str, path: DrivenPath) -> Record:
    folder = f"trajectories/{number:03d}"
    start_from_world = invert_rigid(path.world_from_body[0].double())
    poses = start_from_world @ path.world_from_body.double()
    seconds = (path.timestamps_ns - path.timestamps_ns[0]).double() * 1e-9
    yaw_deg = torch.rad2deg(torch.atan2(poses[:, 1, 0], poses[:, 0, 0]))
    (output / folder).mkdir(parents=True)
    with (output / folder / WAYPOINTS_FILE).open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("time_s", "x_m", "y_m", "z_m", "yaw_deg"))
        rows = torch.cat([seconds[:, None], poses[:, :3, 3], yaw_deg[:, None]], dim=1)
        table.writerows([f"{value:.4f}" for value in row] for row in rows.tolist())
    return {
        "kind": "trajectory",
        "category": category,
        "name": f"way of {category} {number}" if number else "way of the ego",
        "length_m": float(path.travelled_m[-1]),
        "folder": folder,
        "thumbnail": None,
        "world_from_asset": path.world_from_body[0].double(),
    }


def _turned(output: Path, folder: str, model: ActorModel, *, elevation_deg: float) -> str:
    """Write the turntable of a model; its name in the artefact."""
    strip = turntable(model.gaussians, model.size_m, elevation_deg=elevation_deg)
    write_webp(strip, output / folder / THUMBNAIL_FILE)
    return f"{folder}/{THUMBNAIL_FILE}"


def _sized(model: ActorModel) -> Record:
    length_m, width_m, height_m = model.size_m.tolist()
    return {
        "length_m": length_m,
        "width_m": width_m,
        "height_m": height_m,
        "num_gaussians": len(model.gaussians),
        "num_points": len(model.points),
    }


def _when(track: ActorTrack | None, world: EditedWorld) -> Record:
    """First and last time of a track, or of the log."""
    times_ns = world.log.ego.timestamps_ns if track is None else track.timestamps_ns
    first_s, last_s = ((int(times_ns[end]) - world.log.start_ns) * 1e-9 for end in (0, -1))
    return {"first_s": first_s, "last_s": last_s}


def turntable(
    gaussians: GaussianSet, size_m: Float[Tensor, "3"], *, elevation_deg: float = 15.0
) -> Float[Tensor, "height width 3"]:
    """See Gaussians (of body 0, about the origin) from all sides, first from ahead (+x).

    The azimuth grows to the left: ahead, ahead left, left, ... The camera is so far away that a
    box of this size fits.
    """
    pictures = []
    for number in range(NUM_AZIMUTHS):
        azimuth = 2 * math.pi * number / NUM_AZIMUTHS
        camera = camera_around(azimuth, math.radians(elevation_deg), size_m)
        bodies = invert_rigid(camera.world_from_camera)[None].float()
        with torch.no_grad():
            image = draw_gaussians(gaussians, bodies, camera)
        pictures.append(image.rgb.clamp(0, 1) + (1 - image.alpha)[..., None] * BACKGROUND)
    return torch.cat(pictures, dim=1).clamp(0, 1)


def camera_around(azimuth_rad: float, elevation_rad: float, size_m: Float[Tensor, "3"]) -> Camera:
    """A camera that looks at the origin from so far away that a box of this size fits."""
    distance_m = float(size_m.norm()) / 2 * math.hypot(1.0, 2 * _FOCAL_PX / HEIGHT_PX)
    flat = math.cos(elevation_rad)
    away = torch.tensor(
        [flat * math.cos(azimuth_rad), flat * math.sin(azimuth_rad), math.sin(elevation_rad)],
        dtype=torch.float64,
    )
    right = torch.tensor([-math.sin(azimuth_rad), math.cos(azimuth_rad), 0.0]).double()
    down = torch.linalg.cross(-away, right)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, down, -away], dim=1)
    pose[:3, 3] = distance_m * away
    return Camera.centred(pose, _FOCAL_PX, width_px=WIDTH_PX, height_px=HEIGHT_PX)
