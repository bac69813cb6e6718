"""Rounds of a tiny street: with other painters, farther out, taken back and made again."""

from pathlib import Path

import pytest
from commands import settings, succeed
from tiny_street import reconstructed

from flows.cli.reconstruct import show


@pytest.mark.parametrize(
    ("words", "painted"),
    [
        (("--painter", "none"), 0),
        (("--painter", "overlay"), 1),
        (("--painter", "warp", "--shift", "2"), 1),
        (("--rounds", "0", "--set", "rounds=0"), 0),
    ],
    ids=["none", "overlay", "warp, other shifts", "no round"],
)
def test_another_painter_goes_on_from_the_fit_that_is_there(tiny_run, words, painted):
    result = reconstructed(tiny_run, *words, "--json").json
    assert result["run_id"] != tiny_run.run_id
    assert not result["computed_now"]["fit"]
    assert result["artefacts"]["fit"] == tiny_run.result["artefacts"]["fit"]
    assert sum(stage.startswith("paint") for stage in result["seconds"]) == painted
    assert result["recorded"]["psnr"] > 18.7
    assert set(result["guidance"]) == ({"paint-1"} if painted else set())
    assert set(result["gains"]) == ({"refine-1"} if painted else set())
    is_refined = "refine-1" in result["seconds"]
    assert (result["novel"] != result["unpainted"]["novel"]) == is_refined
    assert tiny_run.store.tables.row("runs", result["run_id"])["status"] == "complete"
    last = {"none": "refined"}.get(result["painter"], "painted")
    judged = succeed("evaluate", result["run_id"], "--json", store=tiny_run.store).json
    assert (last in judged) == is_refined
    assert "unpainted" in judged
    rows = tiny_run.store.tables.rows("metrics")
    variants = {row["variant"] for row in rows if row["run_id"] == result["run_id"]}
    assert variants == {"unpainted", last}


def test_a_later_round_paints_farther_out(tiny_run):
    changes = settings("rounds=2", "novel.outwards_m=1")
    words = ("--painter", "warp", "--shift", "2", *changes, "--no-evaluate", "--no-report")
    result = reconstructed(tiny_run, *words, "--json").json
    assert {"refine-1", "refine-2"} <= set(result["seconds"])
    turned = {"turned-left-40deg", "turned-right-40deg"}
    for stage, aside in (
        ("paint-1", {"left-2m", "right-2m"}),
        ("paint-2", {"left-3m", "right-3m"}),
    ):
        shown = Path(result["artefacts"][stage]) / "images"
        assert {path.name for path in shown.iterdir()} == aside | turned


def test_a_round_that_is_taken_back_is_made_again_as_its_control(tiny_run, monkeypatch):
    monkeypatch.setattr("lidarpainter_models.evaluation.round_gain.MOST_LOST_DB", -100.0)
    words = (*settings("refine.steps=8"), "--no-evaluate", "--no-report", "--json")
    painted, control = (
        reconstructed(tiny_run, "--painter", painter, *words).json for painter in ("warp", "none")
    )
    assert painted["gains"]["refine-1"]["is_taken_back"]
    again = painted["artefacts"]["refine-1-unpainted"]
    assert again == control["artefacts"]["refine-1"]
    assert again != painted["artefacts"]["refine-1"]
    assert not control["computed_now"]["refine-1"]


def test_a_round_that_was_taken_back_is_shown(tiny_run, capsys):
    gains = {"refine-1": {"before_db": 25.0, "after_db": 24.0, "is_taken_back": True}}
    show(tiny_run.result)
    assert "taken back" not in capsys.readouterr().out
    show({**tiny_run.result, "gains": gains})
    assert "taken back" in capsys.readouterr().out
