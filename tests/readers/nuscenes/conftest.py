"""A synthetic street as a nuScenes log: whole, read only once, and small, to be damaged."""

import json

import pytest
from nuscenes_log import SCENE_NAME, reduced, street_like_nuscenes, write_nuscenes_log
from written_logs import WrittenLog


class NuscenesLog(WrittenLog):
    """A log whose tables can be changed."""

    @property
    def folder(self):
        return self.root / "v1.0-mini"

    def rows(self, table):
        return json.loads((self.folder / f"{table}.json").read_text())

    def edit(self, table, change):
        """Let `change` work on the rows of a table, then write what it left or gave."""
        rows = self.rows(table)
        changed = change(rows)
        (self.folder / f"{table}.json").write_text(json.dumps(changed or rows))

    def rows_of(self, channel):
        """The rows of `sample_data` of one sensor by time."""
        found = [row for row in self.rows("sample_data") if f"/{channel}/" in row["filename"]]
        return sorted(found, key=lambda row: row["timestamp"])


@pytest.fixture(scope="session")
def street(tmp_path_factory):
    """The truth: seven sweeps, six cameras, far from the origin of the dataset's frame."""
    return street_like_nuscenes(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="session")
def street_log(street, tmp_path_factory):
    """The street written as nuScenes, every third sweep a key frame."""
    root = tmp_path_factory.mktemp("log")
    write_nuscenes_log(street, root, key_every=3)
    return NuscenesLog("nuscenes", root, SCENE_NAME)


@pytest.fixture(scope="session")
def read_street(street_log, tmp_path_factory):
    """What the reader makes of the whole log."""
    return street_log.read(tmp_path_factory.mktemp("store"))


@pytest.fixture(scope="session")
def small_street(street):
    """Four sweeps, two cameras, six actors."""
    return reduced(street, num_frames=4, cameras=("CAM_FRONT", "CAM_BACK_LEFT"), num_actors=6)


@pytest.fixture(scope="session")
def sound_log(small_street, tmp_path_factory):
    """The small street as nuScenes; key frames are the first and the last sweep."""
    root = tmp_path_factory.mktemp("small-log")
    write_nuscenes_log(small_street, root, key_every=3)
    return NuscenesLog("nuscenes", root, SCENE_NAME)
