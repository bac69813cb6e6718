"""Write a log of plain files to practise on: a synthetic street as a car with one camera saw it.

python docs/examples/practice_log.py LOG [FRAMES [WIDTH]]
"""

import csv
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import lidarpainter_models as lp
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def pose_row(map_from_body: torch.Tensor) -> dict[str, float]:
    """Position and unit quaternion of a 4x4 pose, by the names of the CSV files."""
    turned = Rotation.from_matrix(map_from_body[:3, :3].numpy()).as_quat()
    return dict(zip(POSE, [*map_from_body[:3, 3].tolist(), *turned.tolist()], strict=True))


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write a CSV file with the names of the columns in its first line."""
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def write(log: Path, num_frames: int = 20, width_px: int = 480) -> None:
    """Drive along the street and write what the car recorded."""
    street = lp.SyntheticStreetConfig(
        seed=3,
        num_frames=num_frames,
        width_px=width_px,
        height_px=width_px * 9 // 16,
        cameras=DEFAULT_CAMERAS[:1],
    )
    sys.stdout.write(f"drawing {num_frames} frames of a street\n")
    with tempfile.TemporaryDirectory() as folder:
        scene = lp.open_scene(lp.write_street(street, Path(folder)))
        _write_files(scene, log)
    sys.stdout.write(f"the log lies in {log}\n")


def _write_files(scene: DrivingScene, log: Path) -> None:
    (camera,) = scene.camera_names
    for name in ("images", "sweeps"):
        (log / name).mkdir(parents=True, exist_ok=True)
    frames, images, boxes = [], [], []
    for place, frame in enumerate(scene.frame_indices):
        number, view, sweep = f"{frame:06d}", scene.view(frame, camera), scene.sweeps_of(frame)[0]
        row = {"frame": number, "time_ns": sweep.timestamp_ns}
        frames.append(row | pose_row(scene.world_from_ego[place]))
        images.append(
            {"frame": number, "time_ns": view.timestamp_ns}
            | pose_row(view.camera.world_from_camera)
        )
        (log / f"images/{number}.jpg").write_bytes(scene.read_jpeg(view))
        points = scene.read_sweep(sweep)
        columns = [*points.xyz_m.T, points.intensity.float()]
        np.save(log / f"sweeps/{number}.npy", torch.stack(columns, dim=1).numpy())
    for track in scene.tracks:
        size = dict(zip(("length_m", "width_m", "height_m"), track.size_m.tolist(), strict=True))
        for frame, pose in zip(track.frame_indices.tolist(), track.world_from_box, strict=True):
            who = {"frame": f"{frame:06d}", "actor": track.actor_id, "category": track.category}
            moves = {"is_moving": "yes" if track.is_moving else "no"}
            boxes.append(who | pose_row(pose) | size | moves)
    for name, rows in (("frames", frames), ("images", images), ("boxes", boxes)):
        write_rows(log / f"{name}.csv", rows)
    lens = {name: getattr(view.camera, name) for name in LENS}
    height_m = float(sweep.world_from_lidar[2, 3] - scene.world_from_ego[place][2, 3])
    rig = {"licence": "CC0, drawn by LidarPainter", "lens": lens, "lidar_height_m": height_m}
    (log / "rig.json").write_text(json.dumps(rig, indent=1), "utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]), *map(int, sys.argv[2:4]))
