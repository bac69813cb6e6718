"""Take assets out of a fitted scene: actors, blocks of street, the sky, the ways driven.

Each is written into a folder of its own, in its own frame (actors: that of their box) and in
neutral exposure: multiplied so that the road where it was recorded is of one grey.
"""

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.asset_files import write_asset
from lidarpainter_models.assets.seen_surfaces import SeenSurface
from lidarpainter_models.assets.sighted_vehicles import (
    SIGHTED_FILE,
    SightedVehicle,
    write_sighted,
)
from lidarpainter_models.assets.sightings import Sighting
from lidarpainter_models.assets.street_blocks import street_blocks
from lidarpainter_models.assets.turntables import THUMBNAIL_FILE, write_turntable
from lidarpainter_models.assets.whole_actors import LEAST_GAUSSIANS, whole_actor
from lidarpainter_models.assets.written_actors import Record, sized, write_actor
from lidarpainter_models.editing.actor_models import (
    NEUTRAL_ROAD_RGB,
    ActorModel,
    exposed,
    exposure_gain,
)
from lidarpainter_models.editing.worlds import EditedWorld, as_moving
from lidarpainter_models.errors import SceneError
from lidarpainter_models.export.images import write_webp
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.actor_names import path_of_track
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.storage.tensor_files import write_tensors

SKY_FILE, WAYPOINTS_FILE = "sky.safetensors", "waypoints.csv"
SKY_ROWS = 96
"""Rows of a sky's picture."""


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
        surface = source.surfaces.get(track.actor_id)
        try:
            found = source.world.model_of(track) if surface is None else surface.model
        except SceneError:
            continue  # nothing of it was fitted
        if len(found.gaussians) < LEAST_GAUSSIANS:
            continue
        whole = whole_actor(found, surface)
        if len(whole.model.gaussians) < LEAST_GAUSSIANS:
            continue  # what was fitted lies outside its box
        folder = f"actors/{number:03d}"
        neutral = whole.exposed_like(torch.tensor(NEUTRAL_ROAD_RGB))
        written = write_actor(neutral, seen, output, folder, judged_on=source.judged_on)
        if whole.surface is not None:
            kept = SightedVehicle.of(whole.surface, seen)
            write_sighted(output / folder / SIGHTED_FILE, kept)
        yield {
            **written,
            "category": track.category,
            "name": f"{track.category} {track.actor_id[:8]}",
            "actor_id": track.actor_id,
            "is_moving": track.is_moving,
            **_when(track, source.world),
            "world_from_asset": as_moving(track, source.world.log).world_from_box[0].double(),
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
            **sized(model),
            **_when(None, source.world),
            "folder": folder,
            "thumbnail": write_turntable(output, folder, model, elevation_deg=35.0),
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


def _when(track: ActorTrack | None, world: EditedWorld) -> Record:
    """First and last time of a track, or of the log."""
    times_ns = world.log.ego.timestamps_ns if track is None else track.timestamps_ns
    first_s, last_s = ((int(times_ns[end]) - world.log.start_ns) * 1e-9 for end in (0, -1))
    return {"first_s": first_s, "last_s": last_s}
