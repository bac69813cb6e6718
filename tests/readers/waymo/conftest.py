"""One street seen by Waymo's sensors: a scene that is known, and the files of both releases."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from waymo_components import write_v2
from waymo_edits import FILE, refused_line
from waymo_numbers import SEGMENT
from waymo_records import frame_messages, tfrecord, write_v1
from waymo_truth import WaymoTruth, street_config, write_tiny_truth, write_truth

from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import SyntheticStreet

RELEASES = {"v1": write_v1, "v2": write_v2}


@dataclass
class WaymoFolder:
    """Segments on disk that a test may damage."""

    root: Path
    truth: WaymoTruth

    def ingest(self, store, **options):
        return ingest_scene("waymo", self.root, SEGMENT, store, **options)


@pytest.fixture(scope="session")
def street() -> SyntheticStreet:
    return SyntheticStreet(street_config())


@pytest.fixture(scope="session")
def truth(street, tmp_path_factory) -> WaymoTruth:
    return write_truth(street, tmp_path_factory.mktemp("truth"))


@pytest.fixture(scope="session")
def tiny_truth(tmp_path_factory) -> WaymoTruth:
    return write_tiny_truth(tmp_path_factory.mktemp("tiny-truth"))


@pytest.fixture(scope="session")
def scenes(truth, tmp_path_factory) -> dict[str, DrivingScene]:
    """What the reader makes of either release."""
    found = {}
    for release, write in RELEASES.items():
        root = tmp_path_factory.mktemp(release)
        write(truth, root)
        path = WaymoFolder(root, truth).ingest(tmp_path_factory.mktemp(f"store-{release}"))
        found[release] = DrivingScene.open(path)
    return found


@pytest.fixture(params=RELEASES)
def scene(request, scenes) -> DrivingScene:
    """The scene read from one release, then from the other."""
    return scenes[request.param]


@pytest.fixture
def records(tiny_truth, tmp_path) -> WaymoFolder:
    """A small segment of version 1."""
    write_v1(tiny_truth, tmp_path / "v1")
    return WaymoFolder(tmp_path / "v1", tiny_truth)


@pytest.fixture
def components(tiny_truth, tmp_path) -> WaymoFolder:
    """A small segment of version 2."""
    write_v2(tiny_truth, tmp_path / "v2")
    return WaymoFolder(tmp_path / "v2", tiny_truth)


@pytest.fixture(scope="session")
def messages(tiny_truth):
    return frame_messages(tiny_truth)


@pytest.fixture
def refusal(records, tmp_path):
    """Write records, ingest them, and give the one line they are refused with."""

    def refused(content):
        file = records.root / FILE
        file.write_bytes(content if isinstance(content, bytes) else tfrecord(content))
        return refused_line(records, tmp_path / "store", FILE)

    return refused
