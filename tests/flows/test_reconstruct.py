"""The whole command: once, again, killed, twice at once, and with something wrong."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from commands import refuse, settings, succeed
from tiny_diffusion import write_model
from toy_store import SMALL, TOY_SCENE, write_toy_scene
from waiting import until

from catalog.artefacts import ArtefactRef
from catalog.store import open_store
from flows.cli.reconstruct import read_config
from lidarpainter_models.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
LONG_FIT = ("fit.steps=1500", "fit.half_resolution=0")
# the command, with checkpoints as often as a short test needs them
COMMAND = """
import sys
import tasks.reconstruction.fit
from flows.cli.main import main
tasks.reconstruction.fit.CHECKPOINT_EVERY_S = 0.5
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def store(tmp_path):
    store = open_store(tmp_path / "store")
    write_toy_scene(store.root)
    return store


def start(store, *changes):
    assignments = settings(*SMALL, *changes)
    command = ["--store", str(store.root), "reconstruct", TOY_SCENE, "--json", *assignments]
    environment = {**os.environ, "PREFECT_HOME": str(store.root / "prefect")}
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=environment,
    )


def finish(process):
    out, errors = process.communicate(timeout=900)
    assert process.returncode == 0, errors
    return json.loads(out)


def scene_bytes(result):
    return (Path(result["artefacts"]["fit"]) / "scene.safetensors").read_bytes()


@pytest.mark.slow
def test_a_model_in_diffusers_layout_paints_the_views(store, tmp_path):
    folder = write_model(tmp_path / "small-turbo")
    painter = f"{folder}:with-reference"
    result, again = (finish(start(store, f"painter={painter}", "rounds=1")) for _ in range(2))
    assert result["painter"] == painter
    assert {"paint-1", "refine-1"} <= set(result["seconds"])
    assert not any(again["computed_now"].values())


@pytest.mark.slow
def test_a_fit_killed_in_its_middle_goes_on_to_the_same_scene_bit_for_bit(store, tmp_path):
    killed = start(store, *LONG_FIT)
    until(lambda: list(store.root.glob("work/*/fit.safetensors")), seconds=600)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert list(store.root.glob("artefacts/gaussians/*")) == []
    assert list(store.root.glob("work/*/fit.safetensors"))
    resumed = finish(start(store, *LONG_FIT))

    other = open_store(tmp_path / "undisturbed")
    write_toy_scene(other.root)
    undisturbed = finish(start(other, *LONG_FIT))
    assert resumed["run_id"] == undisturbed["run_id"]
    assert scene_bytes(resumed) == scene_bytes(undisturbed)
    assert list(store.root.glob("work/*")) == list(store.root.glob("aside/*")) == []
    assert [row["status"] for row in store.tables.rows("runs")] == ["complete"]


@pytest.mark.slow
def test_two_runs_at_once_share_every_computation(store):
    both = [start(store, *LONG_FIT) for _ in range(2)]
    first, second = (finish(process) for process in both)
    assert first["artefacts"] == second["artefacts"]
    assert first["recorded"] == second["recorded"]
    for stage, computed in first["computed_now"].items():
        assert computed != second["computed_now"][stage], stage
    for row in store.tables.rows("artefacts"):
        store.artefacts.verified(ArtefactRef.of_id(row["artefact_id"]))


def test_events_are_not_promised_where_nobody_can_write_them(store, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)  # as where it is not installed
    words = ("reconstruct", TOY_SCENE, "--tensorboard", "events")
    assert "needs the package tensorboard" in refuse(*words, store=store)
    assert not (store.root / "artefacts").exists()


def test_a_file_says_what_options_do_and_options_count_more(tmp_path, store, monkeypatch):
    path, asked = tmp_path / "run.toml", []
    path.write_text('preset = "brief"\npainter = "none"\nset = ["fit.steps=7", "rounds=1"]\n')

    def known(parameters, _store, *, is_watched):
        assert not is_watched
        asked.append(parameters)
        return {"run_id": "abc"}

    monkeypatch.setattr("flows.cli.running.run_reconstruction", known)
    words = ("reconstruct", TOY_SCENE, "--config", path, "--set", "fit.steps=9", "--json")
    assert succeed(*words, store=store).json == {"run_id": "abc"}
    (found,) = asked
    assert (found.preset, found.painter, found.rounds, found.fit.steps) == ("brief", "none", 1, 9)
    succeed(*words, "--preset", "preview", store=store)
    assert asked[1].preset == "preview"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('presets = "brief"', "unknown key 'presets', expected one of preset, painter, set"),
        ("preset = 3", "preset: expected a string, got 3"),
        ("set = [1]", "set: expected an array of 'key=value', got [1]"),
        ("preset = ", "expected TOML"),
    ],
)
def test_a_file_with_something_else_is_refused_in_one_line(tmp_path, text, expected):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(expected)):
        read_config(path)
