"""What a manifest may say, and the one line that answers everything else."""

import re

import pytest
from small_pandaset import PandasetFolder

from flows.fleet.asked_sequences import Asked, wishes
from flows.fleet.manifest import read_manifest
from lidarpainter_models.errors import ConfigError, DataError, WeightsError

STREETS = '[[source]]\ndataset = "synthetic"\nseeds = "1:3"\n'
GOOD = f'name = "night"\n{STREETS}'
LOGS = '[[source]]\ndataset = "pandaset"\nroot = "logs"\n'
WAY = '[[configuration]]\nname = "short"\nset = ["fit.steps=20"]\n'
FAULTS = {
    "name is missing": STREETS,
    "source is missing": 'name = "night"',
    "name: '../night': expected a name": GOOD.replace("night", "../night"),
    "unknown key 'colour', expected one of name, preset": f'colour = "red"\n{GOOD}',
    "[[source]] 1: unknown key 'seed', expected one of dataset": GOOD + "seed = 3\n",
    "[[source]] 1: seeds: '3:1': expected A:B with A < B": GOOD.replace("1:3", "3:1"),
    "[[source]] 1: seeds: input should be a valid string, got 3": GOOD.replace('"1:3"', "3"),
    "[[source]] 1: root is not for dataset 'synthetic'": f'{GOOD}root = "x"\n',
    "[[source]] 1: frames '2:4': a street begins at frame 0": f'{GOOD}frames = "2:4"\n',
    "[[source]] 1: width_px: input should be greater than or equal": f"{GOOD}width_px=4",
    "[[source]] 2: root is missing": f'{GOOD}[[source]]\ndataset = "waymo"\n',
    "[[source]] 2: root: 'gs://logs': expected a folder": GOOD + LOGS.replace("logs", "gs://logs"),
    "sequences.0: '../../etc': expected the name": f'{GOOD}{LOGS}sequences = ["../../etc"]\n',
    "[[source]] 1: cameras: input should be an array, got 'front'": f'{GOOD}cameras = "front"\n',
    "[budget]: unknown key 'hous', expected one of hours": f"{GOOD}[budget]\nhous = 3\n",
    "[budget]: hours: input should be greater than 0, got -1": f"{GOOD}[budget]\nhours = -1\n",
    "budget: input should be a table, got 3": f"budget = 3\n{GOOD}",
    "publish.0: input should be 'scores', 'examination', 'report' or 'assets', got 'all'": (
        f'publish = ["all"]\n{GOOD}'
    ),
    "[[source]] 1: scenes.0: '002': expected dataset/sequence": (
        'name = "night"\n[[source]]\ndataset = "stored"\nscenes = ["002"]\n'
    ),
    "[[source]] 1: scenes is not for dataset 'synthetic'": f'{GOOD}scenes = ["a/b"]\n',
    "[[configuration]] 1: name is missing": f"{GOOD}[[configuration]]\n",
    "two configurations have one name": f"{GOOD}{2 * WAY}",
    "or two fit_seeds are equal": f"fit_seeds = [1, 1]\n{GOOD}",
    "expected TOML": "name = [[[",
    "expected TOML: maximum recursion": "name = " + "[" * 5000,
}


@pytest.fixture
def written(tmp_path):
    def write(text):
        path = tmp_path / "night.toml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def asked_of(written):
    """The sequences that a manifest's text asks for."""

    def ask(text):
        path = written(text)
        found = wishes(read_manifest(path), path.parent)
        return [Asked.model_validate_json(wish.asked) for wish in found]

    return ask


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line_that_says_where(written, fault):
    path = written(FAULTS[fault])
    with pytest.raises(ConfigError, match=f"^{re.escape(str(path))}: .*{re.escape(fault)}") as told:
        read_manifest(path)
    assert "\n" not in str(told.value)


def test_a_manifest_that_is_absent_or_huge_is_one_line(tmp_path, written):
    with pytest.raises(ConfigError, match=r"no manifest .*: No such file"):
        read_manifest(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="expected a manifest of at most"):
        read_manifest(written("#" * 2_000_000))


def test_a_manifest_saved_by_a_windows_editor_is_read(tmp_path):
    file = tmp_path / "night.toml"
    file.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert read_manifest(file).name == "night"


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_a_manifest_in_another_encoding_says_what_to_do(tmp_path, encoding):
    file = tmp_path / "night.toml"
    file.write_bytes(f"{GOOD}# n\xe4chtens\n".encode(encoding))
    with pytest.raises(ConfigError, match=r"night\.toml: expected TOML in UTF-8: save it"):
        read_manifest(file)


def test_streets_are_drawn_as_the_source_says(asked_of):
    one, two = asked_of(f'{GOOD}frames = "0:6"\nwidth_px = 320\ncameras = ["front_camera"]\n')
    assert [one.scene_id, two.scene_id] == ["synthetic/street-0001", "synthetic/street-0002"]
    street = two.street
    assert (street.seed, street.num_frames, street.width_px, street.height_px) == (2, 6, 320, 180)
    assert [camera.name for camera in street.cameras] == ["front_camera"]


def test_settings_reach_the_parameters(asked_of):
    words = 'painter = "warp"\nset = ["fit.steps=40", "rounds=1"]\npublish = ["scores"]\n'
    parameters = asked_of(words + GOOD)[0].parameters
    assert (parameters.fit.steps, parameters.rounds, parameters.painter) == (40, 1, "warp")
    assert (parameters.judge, parameters.report) == (True, False)


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        ('set = ["fit.step=40"]\n', ConfigError, "no setting 'fit.step'"),
        ('preset = "quick"\n', ConfigError, "no preset 'quick'"),
        ('painter = "rembrandt"\n', WeightsError, "no painter 'rembrandt'"),
        ('variants = ["purple"]\n', ConfigError, "no style 'purple'"),
    ],
)
def test_what_no_sequence_could_do_is_refused_at_once(asked_of, words, error, said):
    with pytest.raises(error, match=said):
        asked_of(words + GOOD)


def test_globs_take_what_lies_there(asked_of, tmp_path):
    for name in ("002", "011", "015"):
        PandasetFolder(tmp_path / "logs", sequence=name).write_log()
    text = f'name = "night"\n{LOGS}'
    assert [one.sequence for one in asked_of(text)] == ["002", "011", "015"]
    chosen = asked_of(f'{text}sequences = ["015", "0?1*", "015"]\n')
    assert [one.sequence for one in chosen] == ["015", "011"]
    assert chosen[0].root == tmp_path / "logs"
    with pytest.raises(ConfigError, match=r"has no sequence '9\*', it has 3 such as 002"):
        asked_of(f'{text}sequences = ["9*"]\n')
    with pytest.raises(DataError, match="no such folder"):
        asked_of(text.replace("logs", "absent"))


def test_bags_may_have_a_map_and_nothing_else_may(asked_of, tmp_path):
    text = 'name = "bags"\n[[source]]\ndataset = "mcap"\nroot = "night.mcap"\nmap = "rig.toml"\n'
    (tmp_path / "night.mcap").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"\[\[source\]\] 1: map: .*rig.toml: no such file"):
        asked_of(text)
    (tmp_path / "rig.toml").write_text("")
    (asked,) = asked_of(text)
    assert (asked.scene_id, asked.rig) == ("mcap/night", tmp_path / "rig.toml")
    with pytest.raises(ConfigError, match="map is not for dataset 'pandaset'"):
        asked_of(f'name = "night"\n{LOGS}map = "rig.toml"\n')


def test_one_scene_with_several_choices_of_cameras_is_read_once_with_all(asked_of):
    one = 'cameras = ["front_camera"]\n'
    both = 'cameras = ["front_left_camera", "front_camera"]\n'
    found = asked_of(f"{GOOD}{one}{STREETS}{both}")
    assert {asked.read_cameras for asked in found} == {("front_camera", "front_left_camera")}
    assert found[0].parameters.train_cameras == ("front_camera",)
    with pytest.raises(ConfigError, match="asked for twice with the same cameras"):
        asked_of(GOOD + STREETS)
    with pytest.raises(ConfigError, match="with different roots, maps, frames or widths"):
        asked_of(f"{GOOD}{one}{STREETS}{both}width_px = 64\n")
    with pytest.raises(ConfigError, match="no camera rear on the street"):
        asked_of(f'{GOOD}cameras = ["rear"]\n')
    with pytest.raises(ConfigError, match="seeds: expected at most"):
        asked_of(GOOD.replace("1:3", "0:999999999"))


def test_every_configuration_is_tried_with_every_seed_on_every_scene(asked_of):
    words = 'painter = "warp"\nset = ["fit.steps=40"]\nfit_seeds = [0, 7]\n'
    found = asked_of(f'{words}{GOOD}{WAY}[[configuration]]\nname = "bare"\npainter = "none"\n')
    assert len(found) == 8
    assert [one.sequence for one in found[:2]] == ["street-0001", "street-0002"]
    by_way = {(one.configuration, one.fit_seed): one.parameters for one in found}
    assert set(by_way) == {("short", 0), ("short", 7), ("bare", 0), ("bare", 7)}
    short, bare = by_way["short", 7], by_way["bare", 0]
    assert (short.fit.steps, short.painter, short.fit.seed, short.refine.seed) == (20, "warp", 7, 7)
    assert (bare.fit.steps, bare.painter, bare.fit.seed) == (40, "none", 0)


def test_each_way_is_a_sequence_of_its_own(written):
    path = written(f"fit_seeds = [0, 7]\n{GOOD}{WAY}")
    found = wishes(read_manifest(path), path.parent)
    assert len({wish.sequence_id for wish in found}) == len({wish.asked for wish in found}) == 4


def test_scenes_of_the_store_are_taken_as_they_are(asked_of):
    text = 'name = "night"\n[[source]]\ndataset = "stored"\nscenes = ["pandaset/002"]\n'
    (one,) = asked_of(text)
    assert (one.scene_id, one.is_stored) == ("pandaset/002", True)
