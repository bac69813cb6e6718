"""From a bag to a scene: `rig` proposes, `ingest mcap` reads, and both say what is missing."""

import pytest
from av2_log import street_like_av2
from bag_log import BagScene, RosWriter, _ros_messages, write_ros_bag
from commands import call, refuse, succeed

from catalog.store import open_store


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return street_like_av2(tmp_path_factory.mktemp("street"))


@pytest.fixture(scope="module")
def bag(street, tmp_path_factory):
    file = tmp_path_factory.mktemp("bag") / "drive.mcap"
    write_ros_bag(street, file)
    return file


def test_proposed_rig_is_written_and_read(bag, tmp_path):
    store, rig = open_store(tmp_path / "store"), tmp_path / "rig.toml"
    printed = succeed("rig", bag)
    shown = succeed("rig", bag, "--out", rig)
    assert rig.read_text() == printed.out
    assert "/lidars/main_pandar64/points" in shown.out
    told = succeed("ingest", "mcap", bag, "--map", rig, "--json", store=store).json["scenes"]
    assert [(row["scene_id"], row["num_frames"], row["num_views"]) for row in told] == [
        ("mcap/drive", 3, 6)
    ]
    again = succeed("ingest", "mcap", bag, "--map", rig, "--json", store=store).json["scenes"]
    assert again == told  # from the notes
    rig.write_text(rig.read_text().replace("ring_front_center", "front", 1))
    line = refuse("ingest", "mcap", bag, "--map", rig, store=store)
    assert "it was kept, --again replaces it" in line
    rows = succeed("ingest", "mcap", bag, "--map", rig, "--again", "--json", store=store).json
    assert rows["scenes"][0]["cameras"] == ["front", "stereo_front_left"]
    is_fit = succeed("doctor", "mcap/drive", "--json", store=store).json["is_fit"]
    assert is_fit


def test_what_is_missing_is_said_and_ends_with_two(street, tmp_path):
    bag, file = BagScene(street), tmp_path / "drive.mcap"
    with RosWriter(file) as writer:
        for log_ns, kind, content in bag.messages():
            if kind not in ("transform", "lens"):
                for topic, message in _ros_messages(writer, bag, log_ns, kind, content):
                    writer.write(f"/{topic}", log_ns, message)
    answer = call("rig", file, "--json")
    assert answer.code == 2
    missing = answer.json["missing"]
    assert any("no pose of the car" in line for line in missing)
    assert sum("no CameraInfo or CameraCalibration for" in line for line in missing) == 2
    assert all(line in answer.err for line in missing)
    assert (
        refuse("ingest", "mcap", file, store=open_store(tmp_path / "store")).count("no pose") == 1
    )


def test_wrong_words_about_bags(bag, tmp_path):
    store = open_store(tmp_path / "store")
    gone = tmp_path / "gone.toml"
    line = refuse("ingest", "mcap", bag, "--map", gone, store=store)
    assert "gone.toml: no such file, expected a rig.toml" in line
    assert "no such bag, expected an MCAP file" in refuse("rig", tmp_path / "gone.mcap")
    gone.write_text("world = 3")
    assert "gone.toml: licence: Field required" in refuse(
        "ingest", "mcap", bag, "--map", gone, store=store
    )
