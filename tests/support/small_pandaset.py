"""A small PandaSet folder made from numbers we know, and scenes written from it.

The car drives at 10 m/s along the diagonal of the dataset's frame, over flat ground; a car ahead
drives at 8 m/s, another is parked on the left. Both LiDARs see the moving one, at other times.
"""

import gzip
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pickled_tables import pickled_table
from scipy.spatial.transform import Rotation

from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.readers.pandaset.dataframe_pickle import read_table_bytes
from lidarpainter_models.scenes.driving_scene import DrivingScene

CAMERAS = ("front", "front_left", "front_right", "left", "right", "back")
CAMERA_YAW_DEG = dict(zip(CAMERAS, (0.0, 57.0, -58.0, 90.0, -90.0, 180.0), strict=True))
WIDTH_PX, HEIGHT_PX = 64, 48
ROAD_DIRECTION = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
LEFT_DIRECTION = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2)
START_M = np.array([100.0, -50.0, 7.0])
START_S = 1_557_539_959.3
EGO_MPS, OTHER_MPS = 10.0, 8.0
OTHER_AHEAD_M, PARKED_AHEAD_M, PARKED_LEFT_M = 12.0, 9.0, 4.0
CAR_SIZE_M = (4.0, 2.0, 1.6)
SPINNING_SEES_S, FORWARD_SEES_S = -0.05, -0.02


# --- the world those tables describe


def ego_position(time_s: float) -> np.ndarray:
    return START_M + EGO_MPS * (time_s - START_S) * ROAD_DIRECTION


def other_position(time_s: float) -> np.ndarray:
    along_m = OTHER_AHEAD_M + OTHER_MPS * (time_s - START_S)
    return START_M + along_m * ROAD_DIRECTION + np.array([0, 0, 0.6])


def parked_position() -> np.ndarray:
    along = PARKED_AHEAD_M * ROAD_DIRECTION + PARKED_LEFT_M * LEFT_DIRECTION
    return START_M + along + np.array([0, 0, 0.6])


def box_surface(centre_m: np.ndarray, seed: int, num_points: int = 60) -> np.ndarray:
    """Points on the vertical faces of a car along the road, a hair inside its box."""
    rng = np.random.default_rng(seed)
    local = rng.uniform(-0.49, 0.49, (num_points, 3)) * CAR_SIZE_M
    side = rng.integers(0, 2, num_points)
    local[np.arange(num_points), side] = (
        0.49 * np.array(CAR_SIZE_M)[side] * rng.choice([-1, 1], num_points)
    )
    axes = np.stack([ROAD_DIRECTION, LEFT_DIRECTION, [0, 0, 1]])
    return centre_m + local @ axes


def _pose(columns: np.ndarray, position: np.ndarray) -> dict[str, dict[str, float]]:
    heading = Rotation.from_matrix(columns).as_quat(scalar_first=True).tolist()
    return {
        "position": dict(zip("xyz", position.tolist(), strict=True)),
        "heading": dict(zip("wxyz", heading, strict=True)),
    }


def camera_axes(camera: str) -> np.ndarray:
    yaw = np.radians(CAMERA_YAW_DEG[camera])
    forward = np.cos(yaw) * ROAD_DIRECTION + np.sin(yaw) * LEFT_DIRECTION
    down = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(down, forward), down, forward], axis=1)


@dataclass
class PandasetFolder:
    """A log on disk that tests may damage."""

    root: Path
    sequence: str = "002"
    num_frames: int = 3
    files: dict[str, bytes] = field(default_factory=dict)

    @property
    def path(self) -> Path:
        return self.root / self.sequence

    def frame_times_s(self) -> list[float]:
        return [START_S + 0.1 * index for index in range(self.num_frames)]

    def write(self, name: str, content: bytes | list | dict) -> None:
        file = self.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if not isinstance(content, bytes):
            content = json.dumps(content).encode()
        file.write_bytes(content)

    def write_table(self, name: str, columns: dict[str, np.ndarray]) -> None:
        self.write(name, gzip.compress(pickled_table(columns), compresslevel=1))

    def read_table(self, name: str) -> dict[str, np.ndarray]:
        return read_table_bytes((self.path / name).read_bytes(), self.path / name)

    def edit_json(self, name: str, change: Callable[[Any], object]) -> None:
        """Let `change` work on what a file holds, then write what it left or gave."""
        value = json.loads((self.path / name).read_text())
        changed = change(value)
        self.write(name, changed if isinstance(changed, list) else value)

    def edit_points(self, index: int, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Put the points of a frame where `change` says."""
        name = f"lidar/{index:02d}.pkl.gz"
        table = self.read_table(name)
        xyz_m = change(np.stack([table[axis] for axis in "xyz"], axis=1))
        self.write_table(name, {**table, **dict(zip("xyz", xyz_m.T, strict=True))})

    def boxes_at(self, time_s: float) -> list[dict[str, Any]]:
        """The parked car once, the moving one as each LiDAR saw it."""
        parked = {"uuid": "parked", "stationary": True, "sensor": -1, "sibling": "-"}
        moving = {"stationary": False}
        spinning = {"uuid": "moving-0", "sensor": 0, "sibling": "moving-1"}
        forward = {"uuid": "moving-1", "sensor": 1, "sibling": "moving-0"}
        return [
            {**parked, "centre": parked_position()},
            {**moving, **spinning, "centre": other_position(time_s + SPINNING_SEES_S)},
            {**moving, **forward, "centre": other_position(time_s + FORWARD_SEES_S)},
        ]

    def write_log(self) -> None:
        times_s = self.frame_times_s()
        right = np.cross(ROAD_DIRECTION, [0, 0, 1])
        vehicle_axes = np.stack([right, ROAD_DIRECTION, [0, 0, 1]], axis=1)
        self.write("lidar/timestamps.json", times_s)
        self.write(
            "lidar/poses.json", [_pose(vehicle_axes, ego_position(time_s)) for time_s in times_s]
        )
        for camera in CAMERAS:
            self._write_camera(camera, [time_s - 0.05 for time_s in times_s])
        classes = {"1": "Ground", "2": "Car"}
        self.write("annotations/semseg/classes.json", classes)
        for index, time_s in enumerate(times_s):
            self._write_points(index, time_s)
            self.write_boxes(index, self.boxes_at(time_s))

    def _write_camera(self, camera: str, times_s: list[float]) -> None:
        folder = f"camera/{camera}_camera"
        lens = {"fx": 40.0, "fy": 41.0, "cx": WIDTH_PX / 2, "cy": HEIGHT_PX / 2}
        self.write(f"{folder}/intrinsics.json", lens)
        self.write(f"{folder}/timestamps.json", times_s)
        places = [ego_position(time_s) + np.array([0, 0, 1.8]) for time_s in times_s]
        self.write(f"{folder}/poses.json", [_pose(camera_axes(camera), place) for place in places])
        for index in range(self.num_frames):
            rng = np.random.default_rng([index, CAMERAS.index(camera)])
            blocks = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
            image = cv2.resize(blocks, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_LINEAR)
            jpeg = cv2.imencode(".jpg", image)[1].tobytes()
            self.write(f"{folder}/{index:02d}.jpg", jpeg)

    def _write_points(self, index: int, time_s: float) -> None:
        steps = np.arange(-18.0, 18.1, 1.5)
        ground = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        ground = START_M + np.column_stack([ground, np.full(len(ground), -0.3)])
        by_spinning, by_forward = time_s + SPINNING_SEES_S, time_s + FORWARD_SEES_S
        seen: list[
            tuple[np.ndarray, np.ndarray | float, int, int]
        ] = [  # points, their times, LiDAR, class
            (ground, time_s - 0.1 * np.linspace(0, 1, len(ground)), 0, 1),
            (box_surface(parked_position(), 5), time_s - 0.03, 0, 2),
            (box_surface(other_position(by_spinning), 6), by_spinning, 0, 2),
            (box_surface(other_position(by_forward), 7), by_forward, 1, 2),
        ]
        xyz_m = np.concatenate([points for points, *_ in seen])
        counts = [len(points) for points, *_ in seen]
        columns = {
            **dict(zip("xyz", xyz_m.T, strict=True)),
            "i": np.full(len(xyz_m), 10.0),
            "t": np.concatenate(
                [np.broadcast_to(times, len(points)) for points, times, *_ in seen]
            ),
            "d": np.repeat([sensor for *_, sensor, _ in seen], counts),
        }
        self.write_table(f"lidar/{index:02d}.pkl.gz", columns)
        classes = np.repeat([kind for *_, kind in seen], counts)
        self.write_table(f"annotations/semseg/{index:02d}.pkl.gz", {"class": classes})

    def write_boxes(self, index: int, boxes: list[dict[str, Any]]) -> None:
        length_m, width_m, height_m = CAR_SIZE_M
        columns = {
            "uuid": np.array([box["uuid"] for box in boxes], dtype=object),
            "label": np.array(["Car"] * len(boxes), dtype=object),
            # the long axis is the box's y: yaw 0 would drive along +y of the dataset
            "yaw": np.radians([box.get("yaw_deg", 45.0 - 90.0) for box in boxes]),
            "stationary": np.array([box["stationary"] for box in boxes]),
            **{
                f"position.{axis}": np.array([box["centre"][i] for box in boxes])
                for i, axis in enumerate("xyz")
            },
            "dimensions.x": np.full(len(boxes), width_m),
            "dimensions.y": np.full(len(boxes), length_m),
            "dimensions.z": np.full(len(boxes), height_m),
            "cuboids.sensor_id": np.array([box["sensor"] for box in boxes]),
            "cuboids.sibling_id": np.array([box["sibling"] for box in boxes], dtype=object),
            "attributes.rider_status": np.array([float("nan")] * len(boxes), dtype=object),
        }
        self.write_table(f"annotations/cuboids/{index:02d}.pkl.gz", columns)

    def ingest(self, store: Path, **options: Any) -> Path:
        return ingest_scene("pandaset", self.root, self.sequence, store, **options)


@pytest.fixture
def pandaset(tmp_path: Path) -> PandasetFolder:
    """A fresh log that a test may damage."""
    folder = PandasetFolder(tmp_path / "pandaset")
    folder.write_log()
    return folder


@pytest.fixture(scope="session")
def sound_pandaset(tmp_path_factory: pytest.TempPathFactory) -> PandasetFolder:
    """One log for all tests that leave it as it is."""
    folder = PandasetFolder(tmp_path_factory.mktemp("log") / "pandaset")
    folder.write_log()
    return folder


@pytest.fixture(scope="session")
def small_scene(
    sound_pandaset: PandasetFolder, tmp_path_factory: pytest.TempPathFactory
) -> DrivingScene:
    """The small log as a stored scene."""
    return DrivingScene.open(sound_pandaset.ingest(tmp_path_factory.mktemp("store")))
