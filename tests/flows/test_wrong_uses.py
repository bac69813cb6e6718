"""Every command, used wrongly: one line that says what was expected, code 2, nothing unexpected."""

import errno
import os
import resource
import shlex
import tempfile
import threading
from contextlib import contextmanager, redirect_stderr
from io import StringIO
from pathlib import Path

import pytest
import torch
from commands import call, refuse
from small_pandaset import PandasetFolder
from toy_store import TOY_SCENE, write_toy_scene
from waiting import until

from catalog.store import Store, open_store
from flows.cli.main import main
from tasks.ingest.ingest import record_scene

IN_SCENE = "stylize latest --prompt rain --in-scene"
RENDER = "render latest --out {tmp}/x --trajectory"
TOY = f"reconstruct {TOY_SCENE}"


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> dict[str, object]:
    """What the words stand for: a store with one scene, a dataset, and files that are none."""
    folder = tmp_path_factory.mktemp("wrong")
    scene = write_toy_scene(folder / "store")
    record_scene(open_store(folder / "store"), scene)
    log = PandasetFolder(folder / "pandaset")
    log.write_log()
    (folder / "garbage.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0garbage!")
    (folder / "file").write_text("some text")
    (folder / "empty").mkdir()
    return {
        "tmp": folder,
        "root": log.root,
        "sequence": log.sequence,
        "store": folder / "store",
        "garbage": folder / "garbage.safetensors",
        "file": folder / "file",
    }


@pytest.fixture(autouse=True)
def no_server(monkeypatch):
    """What is wrong is found before a server is started for it."""

    def start(*_arguments):
        raise RuntimeError("a server is started for a wrong use")

    monkeypatch.setattr("flows.server._start", start)


def refused(words, expected, place):
    """Run the words; they must end in one line that has `expected` in it."""
    written = [word.format(**place) for word in shlex.split(words)]
    store = None if "--store" in written else Store(place["store"])
    assert expected.format(**place) in refuse(*written, store=store)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        # the line itself
        ("frobnicate", "No such command 'frobnicate' (see lidarpainter --help)"),
        ("reconstruct", "Missing argument 'scene' (see lidarpainter reconstruct --help)"),
        (TOY + " --bogus", "No such option: --bogus"),
        ("render latest --out", "'--out' requires an argument"),
        ("demo --seed 9999", "'--seed': Input should be less than or equal to 999"),
        ("ingest pandaset {root} --jobs 0", "greater than or equal to 1"),
        # ingest
        ("ingest lyft {root}", "'lyft' is not known, expected one of pandaset, nuscenes"),
        ("ingest pandaset {tmp}/gone", "no such folder, expected the root of pandaset"),
        ("ingest nuscenes {tmp}/empty", "no nuscenes sequence found"),
        ("ingest pandaset {root} 7", "no such sequence folder"),
        ("ingest pandaset {root} ../x", "'pandaset/../x' is no scene id"),
        ("ingest pandaset {root}/{sequence}", "use its parent {root}, which holds"),
        ("ingest pandaset {root}/{sequence} {sequence}", "use its parent {root}, which holds"),
        ("ingest pandaset {root} --cameras roof", "no camera 'roof', expected some"),
        ("ingest pandaset {root} --cameras a,,b", "--cameras 'a,,b': expected names with commas"),
        ("ingest pandaset {root} --frames 5", "--frames '5': expected A:B, such as 0:17"),
        ("ingest pandaset {root} --frames 5:5", "expected A < B"),
        ("ingest pandaset {root} --frames 900:901", "select none of its"),
        # reconstruct
        ("reconstruct nonsense", "is no scene id, expected dataset/sequence such as"),
        ("reconstruct toy/other", "ingest it first (there is toy/street)"),
        (
            TOY + " --preset fast",
            "no preset 'fast', expected one of brief, preview, balanced, paper",
        ),
        (TOY + " --painter miro", "no painter 'miro': expected one of none, overlay, warp"),
        (TOY + " --painter {tmp}/gone.safetensors", "no painter weights at"),
        (TOY + " --painter {garbage}", "{garbage}"),
        (TOY + " --painter {tmp}", "expected a diffusers folder"),
        (TOY + " --device tpu", "no device 'tpu', expected auto, cpu, cuda or cuda:N"),
        (TOY + " --memory 6", "--memory '6': expected a size such as 6GB, in MB, GB"),
        (
            TOY + " --time-limit 0min",
            "--time-limit '0min': expected a time such as 10min, in s, min, h",
        ),
        (TOY + " --rounds -1", "rounds: Input should be greater than or equal to 0"),
        (TOY + " --split nonsense", "expected alternate, linspace, forward:N:M or all"),
        (TOY + " --split forward:0:0", "forward:0:0"),
        (TOY + " --train-cameras roof", "no camera 'roof'; it has front"),
        (TOY + " --shift 200", "at most 8 metres from the recorded path"),
        (TOY + " --shift -2", "expected positive metres with commas between, such as 2,3"),
        (TOY + " --config absent.toml", "no manifest absent.toml"),
        (TOY + " --set fit.shapes.most_sigma=1", "no setting 'fit.shapes.most_sigma'"),
        (TOY + " --set fit.steps", "expected a setting as key=value"),
        (TOY + " --set fit.stepz=3", "no setting 'fit.stepz': fit has effort, steps, "),
        (TOY + " --set fit.steps=three", "fit.steps=three: Input should be a valid integer"),
        (TOY + " --set fit.steps=-1", "steps must not be negative"),
        (TOY + " --set fit=3", "fit=3: Input should be"),
        (TOY + " --set painter.name=x", "no setting 'painter.name'"),
        (TOY + " --set observation.width_px=100000", "expected at most the 240 px"),
        (TOY + " --set novel.outwards_m=7", "novel.outwards_m in round 2"),
        (TOY + " --set 'novel.shifts=[{{\"lateral_m\": 90}}]'", "at most 8 metres from"),
        (TOY + " --set feature_weights={file}", "{file} is no readable weights file"),
        (TOY + " --set feature_weights={tmp}", "{tmp}"),
        # a run that is none
        (RENDER + " recorded", "no complete run in {store}"),
        (RENDER + " lateral:200", "'lateral:200': 200 m sideways: expected at most 8 metres"),
        (RENDER + " sideways", "expected one of recorded, lateral:METRES"),
        (RENDER + " recorded --fps 5", "--fps needs --video"),
        (RENDER + " recorded --previous mixed,shown", "expected one of them here"),
        (RENDER + " recorded --previous next", "--previous 'next': expected unused, mixed"),
        ("render ffff --trajectory recorded --out x", "no run_id 'ffff' among 0"),
        ("stylize latest --prompt rain --out x --seed -1", "'--seed'"),
        ("stylize latest --prompt foggy:2 --in-scene", "from 0 to 1, got 2"),
        ("stylize latest --prompt foggy --visibility 0 --out x", "above 0"),
        ("stylize latest --prompt rain --strength -1 --in-scene", "from 0 to 1"),
        ("stylize latest --prompt rain", "--out FOLDER"),
        (IN_SCENE + " --trajectory up:1", "--in-scene has no use for --trajectory"),
        (IN_SCENE + " --allow-collisions", "--in-scene has no use for --allow-collisions"),
        ("evaluate latest --protocol guess", "expected paper, truth, neurad"),
        ("evaluate latest --previous mixed", "is judged by --protocol flicker"),
        (
            "evaluate latest --protocol flicker --all-views",
            "--protocol flicker has no use for --all-views",
        ),
        (
            "evaluate latest --protocol cross-camera --feature-weights x",
            "--protocol cross-camera has no use for --feature-weights",
        ),
        # painters
        ("painter benchmark --size 0x3", "expected such as 1024x576"),
        ("painter evaluate --painter nano", "expected --pairs or --run"),
        ("painter evaluate --painter a,a --run latest", "expected each once"),
        (
            "painter evaluate --painter nano --pairs {tmp}/empty",
            "no training pairs in {tmp}/empty: expected index.json",
        ),
        ("painter evaluate --painter nano --run ffff", "no run_id 'ffff'"),
        ("painter harvest", "expected --seeds or --scene"),
        ("painter harvest --seeds x", "expected such as 1000:1004 or 1000,1007"),
        ("painter harvest --seeds 0:3000000000", "expected at most 10000 streets"),
        ("painter harvest --scene toy/other", "ingest it first"),
        ("painter harvest --scene toy/street --split x", "expected alternate"),
        ("painter train", "nothing to train on: expected"),
        ("painter train --seeds 1", "painters train on seeds from 1000 up"),
        ("painter train --seeds 1000 --steps -1", "steps must be positive"),
        ("painter train --seeds 1000 --budget 0", "positive"),
        ("painter train --seeds 1000 --held-back 2", "held_back: Input should"),
        ("painter train --seeds 1000 --prompts clear,snow", "snow"),
        ("painter train --seeds 1000 --start {garbage}", "{garbage}"),
        ("painter train --seeds 1000 --base {tmp}/gone", "has no weights for it"),
        (
            "painter train --seeds 1000 --out {file}/x",
            "--out {file}/x cannot be written: Not a directory",
        ),
        ("painter ablate --pairs-train {tmp} --pairs-test {tmp}", "no training pairs in {tmp}"),
        # the catalog
        ("catalog list nope", "no table 'nope'; there are scenes, runs, artefacts"),
        ("catalog show nothing", "nothing is called 'nothing'"),
        ("catalog show ''", "expected an id or the beginning of one"),
        ("catalog show latest", "no complete run in {store}"),
        ("catalog explain toy/street", "no complete run of toy/street in {store}"),
        (
            "render toy/street --out {tmp}/x --trajectory recorded",
            "no complete run of toy/street in",
        ),
        ("export latest --format obj --out x", "--format 'obj': expected one of ply"),
        ("assets list --sides a,,b", "--sides 'a,,b': expected names with commas"),
        ("catalog delete nothing --yes", "nothing is called 'nothing'"),
        ("catalog delete ../.. --yes", "nothing is called '../..'"),
        ("catalog delete toy/street", "nobody can be asked whether to delete this"),
        # doctor
        ("doctor toy/other", "ingest it first"),
        ("doctor toy/street --out {file}/x.png", "cannot write {file}/x.png"),
        # the store
        ("--store {file} catalog list", "is a file, expected a folder"),
        ("--store {file}/x catalog list", "no store at {file}/x"),
        ("--store {file}/x ingest pandaset {root}", "a part of the path is not a folder"),
        ("--store /proc/x ingest pandaset {root}", "/proc/x cannot be written"),
        ("demo --out {file}", "the store {file}/store cannot be written: Not a directory"),
    ],
)
def test_a_wrong_use_is_one_line_and_code_two(place, words, expected):
    refused(words, expected, place)


@pytest.mark.parametrize(
    "words",
    [
        "catalog list",
        "catalog show latest",
        "catalog explain latest",
        "evaluate latest",
        "render latest --trajectory recorded --out x",
        "stylize latest --prompt rain --out x",
        TOY,
        f"doctor {TOY_SCENE}",
        "painter evaluate --painter nano --run latest",
    ],
)
def test_before_anything_was_ingested_there_is_no_store(place, tmp_path, words):
    expected = f"no store at {tmp_path}/none: `ingest` or `demo` makes one"
    refused(f"--store {tmp_path}/none {words}", expected, place)
    assert not (tmp_path / "none").exists()


@pytest.mark.skipif(torch.cuda.is_available(), reason="the device is there")
@pytest.mark.parametrize("words", [TOY, "painter benchmark"])
def test_a_device_that_is_not_there(place, words):
    refused(f"{words} --device cuda", "no CUDA device works here, expected cpu or auto", place)


def test_a_dataset_that_doctor_cannot_read_is_a_finding(place, tmp_path):
    """One broken sequence says so in the table of all, and the code is 2."""
    source = Path(place["root"]) / place["sequence"]
    broken = tmp_path / "root" / "7"
    for file in source.rglob("*"):
        if file.is_file():
            copy = broken / file.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            os.link(file, copy)
    (broken / "lidar/poses.json").unlink()
    (broken / "lidar/poses.json").write_text("{")
    words = ("doctor", "pandaset", tmp_path / "root", "--json")
    answer = call(*words, store=Store(tmp_path / "store"))
    assert answer.code == 2
    assert "poses.json" in answer.out
    assert answer.err == ""


@contextmanager
def files_of_at_most(num_bytes):
    """As on a disk that is full: the kernel refuses to make a file longer."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("num_bytes", [0, 1, 4_000, 20_000])
def test_a_disk_that_is_full(place, tmp_path, num_bytes):
    words = f"--store {tmp_path}/store ingest pandaset {{root}}"
    with files_of_at_most(num_bytes):
        refused(words, str(tmp_path / "store"), place)
    assert not list((tmp_path / "store").glob("scenes/*/*/manifest.json"))


def test_a_store_that_is_read_only(place, tmp_path, monkeypatch):
    def refuse(**_options):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    words = f"--store {tmp_path} ingest pandaset {{root}}"
    refused(words, f"the store {tmp_path} cannot be written: Read-only file system", place)


def test_the_second_of_two_says_whom_it_waits_for(place, tmp_path):
    store, said, codes = open_store(tmp_path), StringIO(), []
    words = ["--store", str(tmp_path), "ingest", "pandaset", str(place["root"])]
    scene_id = f"pandaset/{place['sequence']}"
    with redirect_stderr(said):
        second = threading.Thread(target=lambda: codes.append(main(words)))
        with store.scene_lock(scene_id):
            second.start()
            until(lambda: "waiting for process" in said.getvalue())
            assert not (store.root / "scenes").exists()
        second.join()
    assert f"ingest: waiting for process {os.getpid()}" in said.getvalue()
    assert codes == [0]
