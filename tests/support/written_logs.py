"""One small sound log of every dataset on disk, for what must hold of every reader.

A reader joins by an entry in `WRITERS`; the contract says so when one is missing.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from av2_log import LOG, street_like_av2, write_av2_log
from bag_log import write_foxglove_bag, write_ros_bag
from drawn_streets import recorded_street
from kitti_log import DRIVE, SEQUENCE, write_kitti_raw, write_kitti_tracking
from ncore_log import SEQUENCE as NCORE_SEQUENCE
from ncore_log import write_ncore_log
from nuscenes_log import SCENE_NAME, reduced, street_like_nuscenes, write_nuscenes_log
from small_pandaset import PandasetFolder
from waymo_components import write_v2
from waymo_numbers import SEGMENT
from waymo_records import write_v1
from waymo_truth import write_tiny_truth

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import RigCamera


@dataclass(frozen=True)
class WrittenLog:
    """A log as downloaded, and what it takes to read it."""

    dataset: str
    root: Path
    sequence: str
    unlisted: tuple[str, ...] = ()
    """Parts of paths of files that no other file names: one that is gone was never recorded."""

    def is_listed(self, file):
        """Whether something else in the log says that a file is there."""
        return not any(part in str(file.relative_to(self.root)) for part in self.unlisted)

    def ingest(self, store, **options):
        return ingest_scene(self.dataset, self.root, self.sequence, store, **options)

    def read(self, store, **options):
        return DrivingScene.open(self.ingest(store, **options))

    def refusal(self, store, **options):
        """The one line with which it is refused; no file is left in the store."""
        with pytest.raises(DataError) as raised:
            self.ingest(store, **options)
        assert type(raised.value) is DataError
        assert [path for path in store.rglob("*") if path.is_file()] == []
        message = str(raised.value)
        assert "\n" not in message
        assert str(self.root) in message
        return message

    def copied(self, root):
        """The same log elsewhere, free to be damaged."""
        shutil.copytree(self.root, root)
        return replace(self, root=root)

    def files(self):
        return sorted(path for path in self.root.rglob("*") if path.is_file())


def _pandaset(folder: Path) -> WrittenLog:
    log = PandasetFolder(folder / "pandaset")
    log.write_log()
    return WrittenLog("pandaset", log.root, log.sequence)


def _av2(folder: Path) -> WrittenLog:
    write_av2_log(street_like_av2(folder / "street"), folder / "av2")
    unlisted = ("sensors/", "map/", "annotations.feather")
    return WrittenLog("av2", folder / "av2", LOG, unlisted)


def _kitti_raw(folder: Path) -> WrittenLog:
    write_kitti_raw(_street_like_kitti(folder), folder / "kitti")
    unlisted = ("velodyne_points/", "timestamps.txt", "tracklet_labels.xml")
    return WrittenLog("kitti", folder / "kitti", DRIVE, unlisted)


def _kitti_tracking(folder: Path) -> WrittenLog:
    write_kitti_tracking(_street_like_kitti(folder), folder / "kitti")
    return WrittenLog("kitti", folder / "kitti", SEQUENCE, ("velodyne/", "label_02/"))


def _street_like_kitti(folder: Path) -> DrivingScene:
    cameras = tuple(
        RigCamera(name=f"image_0{number}", focal_per_width=0.6, left_m=left_m)
        for number, left_m in ((2, 0.06), (3, -0.48))
    )
    return recorded_street(folder / "street", cameras)


def _bag(folder: Path, write: Callable[..., object]) -> WrittenLog:
    write(street_like_av2(folder / "street"), folder / "bags/drive.mcap")
    return WrittenLog("mcap", folder / "bags", "drive")


def _ncore(folder: Path, store_type: str, zarr_format: int) -> WrittenLog:
    scene = street_like_av2(folder / "street")
    how = {"store_type": store_type, "zarr_format": zarr_format}
    write_ncore_log(scene, folder / "ncore", **how)
    (folder / "ncore" / f"{NCORE_SEQUENCE}.json").unlink()  # who has the stores needs no list
    for file in (folder / "ncore").glob("*/zarr.json.cbor.zlib"):
        file.unlink()  # what a folder says of itself in one piece may be absent
    return WrittenLog("ncore", folder / "ncore", NCORE_SEQUENCE, ("ncore4-",))


def _canonical(folder: Path) -> WrittenLog:
    scene = _pandaset(folder).ingest(folder / "store")
    return WrittenLog("canonical", scene.parent, scene.name)


def _nuscenes(folder: Path) -> WrittenLog:
    street = street_like_nuscenes(folder / "street")
    small = reduced(street, num_frames=4, cameras=("CAM_FRONT", "CAM_BACK_LEFT"), num_actors=6)
    write_nuscenes_log(small, folder / "nuscenes", key_every=3)
    return WrittenLog("nuscenes", folder / "nuscenes", SCENE_NAME)


def _waymo(folder: Path, write: Callable[..., object]) -> WrittenLog:
    write(write_tiny_truth(folder / "truth"), folder / "waymo")
    return WrittenLog("waymo", folder / "waymo", SEGMENT)


WRITERS: dict[str, Callable[[Path], WrittenLog]] = {
    "pandaset": _pandaset,
    "nuscenes": _nuscenes,
    "waymo, version 1": lambda folder: _waymo(folder, write_v1),
    "waymo, version 2": lambda folder: _waymo(folder, write_v2),
    "av2": _av2,
    "kitti, raw": _kitti_raw,
    "kitti, tracking": _kitti_tracking,
    "mcap, ROS 2": lambda folder: _bag(folder, write_ros_bag),
    "mcap, Foxglove": lambda folder: _bag(folder, write_foxglove_bag),
    "ncore, archives": lambda folder: _ncore(folder, "itar", 2),
    "ncore, folders": lambda folder: _ncore(folder, "directory", 3),
    "canonical": _canonical,
}
"""Writes a log into a folder, by what it is called in tests: the dataset, and its version."""
