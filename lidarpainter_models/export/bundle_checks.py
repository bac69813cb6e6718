"""What somebody who loads a bundle into a driving simulator would miss in it.

Of each part of a bundle a line: what is there, what is lacking and who would notice. AlpaSim loads
`metadata.yaml`, rig, tracks and meshes and pins the `uuid`; CARLA drives on `map.xodr`; whoever
renders the Gaussians reads the layer. Bundles of others are judged by the same lines.
"""

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from uuid import UUID
from zipfile import ZipInfo

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from lidarpainter_models.checks.verdicts import Verdict
from lidarpainter_models.errors import DataError
from lidarpainter_models.export.bundle_reading import (
    MOST_XML_BYTES,
    OpenedBundle,
    numbers,
    opened_bundle,
    part,
)
from lidarpainter_models.export.meshes import MOST_BYTES as MOST_MESH_BYTES
from lidarpainter_models.export.meshes import mesh_of_ply
from lidarpainter_models.export.simulator_bundle import ALIGNED_BYTES

LAYER_ENDINGS = (".usdc", ".usda", ".usd")
MAP_FOLDERS = ("map_data/", "clipgt/", "fastmap/")
"""Where AlpaSim looks for a map first; then for `map.xodr`."""
MAP_FILE = "map.xodr"
METADATA = (
    *("scene_id", "version_string", "training_date", "dataset_hash", "uuid", "is_resumable"),
    *("sensors", "logger", "time_range", "training_step_outputs"),
)
NEAR_PATH_M, MOST_GAP_M = 1.75, 0.3
"""A hole of the ground so wide, on the lane that was driven, stops a simulated car."""
MOST_PLACES = 100
"""Places of the path around which holes are looked for."""
LOOKED_FROM_M = 3.0
"""Above the path: lower than a bridge."""
PROBE_S = 60
"""The longest that a layer may take to open."""
_PROBE = """
import sys
from pxr import Usd
stage = Usd.Stage.Open(sys.argv[1])
kinds = [prim.GetTypeName() for prim in stage.Traverse()]
sys.stdout.write(f"{kinds.count('ParticleField3DGaussianSplat')} {sum(map(bool, kinds))}")
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class BundleFinding:
    """One line about a bundle."""

    name: str
    """The part that it is about."""
    verdict: Verdict
    detail: str


def check_bundle(path: Path) -> list[BundleFinding]:
    """Look at all parts of a bundle.

    Raises:
        DataError: it is no zip, or one that is made to do harm.
    """
    found: list[BundleFinding] = []
    with opened_bundle(path) as bundle:
        for name, check in _CHECKS.items():
            try:
                lines = list(check(bundle))
            except DataError as error:
                lines = [("fail", str(error))]
            found += [
                BundleFinding(name=name, verdict=verdict, detail=said) for verdict, said in lines
            ]
    return found


Lines = Iterator[tuple[Verdict, str]]


def _layer(bundle: OpenedBundle) -> Lines:
    name, entry = next(iter(bundle.members.items()), ("", None))
    if entry is None or not name.endswith(LAYER_ENDINGS):
        raise DataError(
            f"the first member is {name!r}, expected a layer of USD: nothing that reads .usdz "
            "finds the Gaussians"
        )
    if any(one.compress_type for one in bundle.members.values()):
        yield "fail", "members are compressed: programs that read .usdz refuse the file"
    with bundle.path.open("rb") as file:
        loose = [
            one.filename for one in bundle.members.values() if _start(file, one) % ALIGNED_BYTES
        ]
    if loose:
        yield "warn", f"{len(loose)} members do not begin at multiples of 64 bytes, as .usdz asks"
    count, prims = _probed(bundle, name)
    if count:
        yield "ok", f"{name} opens and holds {count} fields of Gaussians among {prims} prims"
    else:
        yield "warn", f"{name} holds no ParticleField: its Gaussians have a form of somebody's own"


def _start(file: BinaryIO, entry: ZipInfo) -> int:
    """Where the bytes of a member begin."""
    file.seek(entry.header_offset + 26)
    name_bytes, extra_bytes = np.frombuffer(file.read(4).ljust(4, b"\0"), "<u2")
    return int(entry.header_offset + 30 + int(name_bytes) + int(extra_bytes))


def _probed(bundle: OpenedBundle, name: str) -> tuple[int, int]:
    """How many fields of Gaussians and prims a layer has; opened in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"layer{Path(name).suffix}"
        path.write_bytes(bundle.read(name, 2**32))
        try:
            done = subprocess.run(  # noqa: S603  our own words
                [sys.executable, "-c", _PROBE, str(path)],
                capture_output=True,
                text=True,
                timeout=PROBE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise DataError(f"{name} does not open within {PROBE_S} s") from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it crashed"])[-1]
        raise DataError(f"{name} cannot be opened by usd-core: {last[:160]}")
    fields, prims = done.stdout.split()[-2:]
    return int(fields), int(prims)


def _metadata(bundle: OpenedBundle) -> Lines:
    said = bundle.yaml("metadata.yaml")
    lacking = [key for key in METADATA if not isinstance(said, dict) or key not in said]
    if lacking:
        raise DataError(f"metadata.yaml lacks {', '.join(lacking)}: AlpaSim does not load it")
    try:
        UUID(str(said["uuid"]))
    except ValueError:
        yield "fail", f"uuid {str(said['uuid'])[:60]!r} is none: no suite can pin this scene"
    start, end = numbers(
        [part(said, "time_range", key) for key in ("start", "end")], "time_range", 2
    )
    if start >= end:
        yield "fail", "time_range ends before it starts"
    cameras = part(said, "sensors", "camera_ids")
    yield "ok", f"scene {str(said['scene_id'])[:80]!r}, {end - start:.1f} s, {len(cameras)} cameras"
    outputs = said["training_step_outputs"]
    if not isinstance(outputs, dict) or not any("envelope" in str(key) for key in outputs):
        yield "warn", "says nothing of how far from its path the scene can be trusted"
    else:
        yield _trusted(outputs)


def _trusted(outputs: dict[str, Any]) -> tuple[Verdict, str]:
    """What an envelope of ours says of the whole path."""
    sides = ("left", "right")
    reach = numbers([outputs.get(f"envelope_{side}_m", -1) for side in sides], "envelope", 2)
    if reach.min() < 0:
        return "warn", "not trusted on all of its own path: see envelope_000_confidence and on"
    return "ok", f"trusted {reach[0]:g} m to the left and {reach[1]:g} m to the right of its path"


def _rig(bundle: OpenedBundle) -> Lines:
    said = bundle.json("rig_trajectories.json")
    _rigid(
        numbers(part(said, "world_to_nre", "matrix"), "world_to_nre.matrix", 4, 4)[None], "matrix"
    )
    for trajectory in part(said, "rig_trajectories"):
        times = numbers(part(trajectory, "T_rig_world_timestamps_us"), "rig times", -1)
        poses = numbers(part(trajectory, "T_rig_worlds"), "T_rig_worlds", -1, 4, 4)
        if len(times) != len(poses) or len(times) < 2 or (np.diff(times) <= 0).any():
            raise DataError(
                "rig times do not ascend, or are not as many as poses, or fewer than two"
            )
        _rigid(poses, "T_rig_worlds")
        yield from _exposures(said, trajectory, times)
        if trajectory.get("rig_bbox") is None:
            yield "warn", "rig_bbox is null: AlpaSim needs the size of the car from its user"
        length_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
        yield "ok", f"{len(poses)} poses over {length_m:.1f} m, rigid and in order"
    if "T_world_base" not in said:
        yield "warn", "no T_world_base: nobody can tell where on earth this is"


def _exposures(
    said: dict[str, Any], trajectory: dict[str, Any], times: Float[np.ndarray, " times"]
) -> Lines:
    """Lines about the cameras of a trajectory and when they exposed."""
    calibrations, exposures = (
        part(said, "camera_calibrations"),
        part(trajectory, "cameras_frame_timestamps_us"),
    )
    for camera, spans in exposures.items():
        if camera not in calibrations or "logical_sensor_name" not in calibrations[camera]:
            raise DataError(f"camera {camera[:80]!r} has no calibration with a logical_sensor_name")
        span = numbers(spans, f"exposures of {camera[:80]}", -1, 2)
        if (span[:, 1] <= span[:, 0]).any():
            raise DataError(f"camera {camera[:80]!r}: an exposure ends no later than it starts")
        if len(span) and (span[:, 1].max() > times[-1] or span[:, 1].min() < times[0]):
            yield "warn", f"camera {camera[:80]!r} exposes while no pose of the rig is known"
    bare = [name for name, one in calibrations.items() if "T_sensor_rig" not in one]
    if bare:
        yield (
            "warn",
            f"{len(bare)} cameras have no T_sensor_rig: their place is the renderer's word",
        )
    yield "ok", f"{len(exposures)} cameras, each exposure after the one before ends in order"


def _rigid(poses: Float[np.ndarray, "poses 4 4"], name: str) -> None:
    """Refuse what moves a car into another shape."""
    rotation = poses[:, :3, :3]
    is_off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max() > 1e-3
    if is_off or np.abs(poses[:, 3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DataError(f"{name}: a pose is no rotation and translation")


def _tracks(bundle: OpenedBundle) -> Lines:
    said = bundle.json("sequence_tracks.json")
    if not isinstance(said, dict) or len(said) != 1:
        raise DataError("sequence_tracks.json: expected one sequence")
    (sequence,) = said.values()
    keys = ("id", "label_class", "flags", "timestamps_us", "poses")
    columns = {key: part(sequence, "tracks_data", f"tracks_{key}") for key in keys}
    dims = numbers(part(sequence, "cuboidtracks_data", "cuboids_dims"), "cuboids_dims", -1, 3)
    if {len(column) for column in columns.values()} | {len(dims)} != {len(dims)}:
        raise DataError("tracks_data and cuboids_dims hold different numbers of tracks")
    if len(set(map(str, columns["id"]))) < len(dims) or (dims <= 0).any():
        raise DataError("two tracks have one id, or a box has no size")
    for name, times, poses in zip(
        columns["id"], columns["timestamps_us"], columns["poses"], strict=True
    ):
        moments = numbers(times, f"times of track {str(name)[:40]}", -1)
        placed = numbers(poses, f"poses of track {str(name)[:40]}", -1, 7)
        turned = np.abs(np.linalg.norm(placed[:, 3:], axis=1) - 1) > 1e-3
        if len(moments) != len(placed) or (np.diff(moments) <= 0).any() or turned.any():
            raise DataError(f"track {str(name)[:40]!r}: times out of order, or no unit quaternions")
    movable = sum("CONTROLLABLE" in flags for flags in columns["flags"])
    yield "ok" if movable else "warn", f"{len(dims)} tracks, {movable} of which may be moved"


def _meshes(bundle: OpenedBundle) -> Lines:
    vertices, faces = mesh_of_ply(bundle.read("mesh.ply", MOST_MESH_BYTES), "mesh.ply")
    yield "ok", f"mesh.ply: {len(vertices)} vertices, {len(faces)} faces"
    name = "mesh_ground.ply"
    vertices, faces = mesh_of_ply(bundle.read(name, MOST_MESH_BYTES), name)
    said = bundle.json("rig_trajectories.json")
    poses = numbers(part(said, "rig_trajectories", 0, "T_rig_worlds"), "T_rig_worlds", -1, 4, 4)
    nre = numbers(part(said, "world_to_nre", "matrix"), "world_to_nre.matrix", 4, 4)
    height, widest = _below(vertices, faces, (nre @ poses)[:, :3, 3])
    if not np.isfinite(height).any():
        raise DataError(f"{name}: lies nowhere below the path")
    share = float(np.isfinite(height).mean())
    middle = float(np.nanmedian(height))
    verdict: Verdict = "ok" if share == 1 and abs(middle) < 4 and widest <= MOST_GAP_M else "warn"
    yield (
        verdict,
        (
            f"{name}: {len(faces)} faces, below {share:.0%} of the path, {middle:.2f} m "
            f"under the rig, widest hole within {NEAR_PATH_M:g} m of it {widest:.1f} m"
        ),
    )


def _below(
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    path_m: Float[np.ndarray, "poses 3"],
) -> tuple[Float[np.ndarray, " poses"], float]:
    """How high a path runs above a mesh, NaN where over none; the widest hole near it."""
    import open3d

    tensor: Any = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        tensor(vertices.astype(np.float32)),
        tensor(faces.astype(np.uint32)),
    )
    aside = np.arange(-NEAR_PATH_M, NEAR_PATH_M + 0.01, 0.1)
    grid = np.stack([*np.meshgrid(aside, aside), np.zeros((len(aside), len(aside)))], axis=-1)
    looked_at = path_m[:: 1 + len(path_m) // MOST_PLACES, None]
    places = (looked_at + grid.reshape(-1, 3)).reshape(-1, 3)
    below, above = [], np.array([0.0, 0.0, LOOKED_FROM_M])
    for points in (path_m, places):
        down = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
        rays = np.concatenate([points + above, down], axis=1)
        found = scene.cast_rays(tensor(rays.astype(np.float32)))["t_hit"].numpy()
        below.append(np.where(np.isfinite(found), found - LOOKED_FROM_M, np.nan))
    known = np.isfinite(below[1])
    if known.all() or not known.any():
        return below[0], 0.0 if known.all() else np.inf
    reach_m, _ = cKDTree(places[known, :2]).query(places[~known, :2])
    return below[0], 2 * float(reach_m.max())


def _map(bundle: OpenedBundle) -> Lines:
    folders = [one for one in MAP_FOLDERS if any(name.startswith(one) for name in bundle.members)]
    if folders:
        yield "ok", f"a map of AlpaSim's in {folders[0]}; its contents were not looked at"
    if MAP_FILE not in bundle:
        if not folders:
            yield "warn", "no map: CARLA has no road to drive on, AlpaSim no lanes to measure by"
        return
    content = bundle.read(MAP_FILE, MOST_XML_BYTES)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise DataError(f"{MAP_FILE} has a document type, which no map needs")
    try:
        root = ET.fromstring(content)  # noqa: S314  without entities nothing grows
    except (ET.ParseError, ValueError, RecursionError) as error:
        raise DataError(f"{MAP_FILE} is no XML: {error}") from None
    lanes = [lane for lane in root.iter("lane") if lane.get("type") == "driving"]
    if root.tag != "OpenDRIVE" or not lanes:
        raise DataError(f"{MAP_FILE}: expected OpenDRIVE with at least one driving lane")
    assumed = sum(one.get("code") == "assumed" for lane in lanes for one in lane.iter("userData"))
    yield "ok", f"{MAP_FILE}: {len(list(root.iter('road')))} roads, {len(lanes)} driving lanes"
    if assumed:
        yield "warn", f"{MAP_FILE}: of {assumed} lanes something is assumed, not seen (`userData`)"


_CHECKS: dict[str, Callable[[OpenedBundle], Lines]] = {
    "layer": _layer,
    "metadata": _metadata,
    "rig": _rig,
    "tracks": _tracks,
    "meshes": _meshes,
    "map": _map,
}
