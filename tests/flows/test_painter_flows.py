"""The painter's commands on a tiny street and tiny networks: harvest, train, evaluate, ablate."""

import json
from pathlib import Path

import pytest
from commands import SMALL_TRAINING, settings, succeed
from random_pairs import write_pairs
from tiny_street import SCENE, WIDTH_PX

from lidarpainter_models.painter.known_painters import PAINTER_NAMES
from lidarpainter_models.training_data.pairs import PairFolder

PLAN = {
    "fit": {
        "steps": 10,
        "initialisation": {"num_gaussians": 800},
        "densification": {"budget": 1000},
    },
    "num_views": 2,
    "shifts": {"crowded_share": 1.0},
}
HARVEST = settings(
    f"street_plans=[{json.dumps(PLAN)}]", f"harvest.observations.width_px={WIDTH_PX}"
)


@pytest.fixture(scope="module")
def harvested(tiny_run):
    words = ("painter", "harvest", "--scene", SCENE, *HARVEST, "--json")
    return succeed(*words, store=tiny_run.store).json


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """Pairs of a log that may train, and others to judge by."""
    folder = tmp_path_factory.mktemp("pairs")
    write_pairs(folder / "learn", range(4))
    write_pairs(folder / "judge", range(10, 12))
    return folder


@pytest.fixture(scope="module")
def trained(tiny_run, pairs):
    words = ("--pairs", pairs / "learn", "--steps", 2, "--held-back", 0.3, *SMALL_TRAINING)
    out = pairs / "trained"
    return succeed("painter", "train", *words, "--out", out, "--json", store=tiny_run.store).json


def test_harvest_pairs_shifted_renders_with_the_truth_and_only_once(tiny_run, harvested):
    (made,) = harvested["pairs"]
    folder = PairFolder(Path(made["folder"]))
    assert (made["set"], made["num_targets"]) == (SCENE, 2)
    assert len(folder) == made["num_pairs"] == 4  # as the fit left it, and damaged
    pair = folder.read(0)
    assert pair.target_rgb.shape[1] == WIDTH_PX
    assert float(pair.target_rgb.std()) > 0.02
    assert float((pair.conditions.render_rgb - pair.target_rgb).abs().mean()) > 0.005
    words = ("painter", "harvest", "--scene", SCENE, *HARVEST, "--json")
    (again,) = succeed(*words, store=tiny_run.store).json["pairs"]
    assert (again["folder"], again["computed_now"]) == (made["folder"], False)


def test_train_learns_judges_itself_and_enters_the_catalog(tiny_run, trained, pairs):
    weights = pairs / "trained" / "nano.safetensors"
    assert trained["weights"] == str(weights)
    assert weights.stat().st_size == trained["num_bytes"]
    assert trained["record"]["steps"] == 2
    assert trained["held_back"]["total"]["num_pairs"] == 2  # 0.3 of four targets, rounded up
    rows = succeed("catalog", "list", "painters", "--json", store=tiny_run.store).json["rows"]
    (row,) = [row for row in rows if row["painter_id"] == trained["painter_id"]]
    record = json.loads(weights.with_suffix(".json").read_text("utf-8"))
    assert row["record"]["training_digest"] == record["training_digest"]
    assert record["held_back_scores"]["total"]["num_pairs"] == 2
    # the pairs it learnt from judge it never
    words = ("--painter", weights, "--pairs", pairs / "learn", "--json")
    judged = succeed("painter", "evaluate", *words, store=tiny_run.store).json["pairs"]
    assert (judged["learn"]["num_judged"], judged["learn"]["num_left_out"]) == (2, 2)


def test_info_of_every_painter_that_needs_no_download(trained):
    own = [name for name in PAINTER_NAMES if name != "sd-turbo"]
    for name in (*own, trained["weights"]):
        found = succeed("painter", "info", "--painter", name, "--json").json
        assert found["painter"] == name
        assert (found["num_parameters"] > 0) == (found["num_bytes"] > 0)
        told = succeed("painter", "info", "--painter", name).out
        assert found["architecture"]["summary"] in " ".join(told.split())


def test_evaluate_judges_painters_on_pairs_and_on_views_of_a_run(
    tiny_run, harvested, trained, pairs
):
    names = ["none", "overlay", "nano", trained["weights"]]
    painters = [word for name in names for word in ("--painter", name)]
    folders = f"{harvested['pairs'][0]['folder']},{pairs / 'judge'}"
    words = ("painter", "evaluate", *painters, "--pairs", folders, "--json")
    found = succeed(*words, store=tiny_run.store).json
    assert list(found["painters"]) == names
    totals = {name: found["painters"][name]["total"] for name in names}
    assert {total["num_pairs"] for total in totals.values()} == {6}
    assert totals["none"]["painted"]["psnr"] == totals["none"]["input"]["psnr"]
    assert totals["nano"]["painted"]["psnr"] != totals["nano"]["input"]["psnr"]

    words = ("painter", "evaluate", "--painter", "none,overlay", "--run", tiny_run.run_id)
    sources = succeed(*words, "--json", store=tiny_run.store).json["pairs"]
    assert set(sources) == {f"{SCENE} {name}" for name in ("left-2m", "up-1.5m")}
    assert all(source["num_judged"] > 0 for source in sources.values())
    assert "overlay" in succeed(*words, store=tiny_run.store).out


def test_ablate_trains_every_variant_and_judges_all_alike(tiny_run, pairs):
    words = ("--pairs-train", pairs / "learn", "--pairs-test", pairs / "judge")
    words = (*words, "--table", "skips,fusion", "--steps", 1, *SMALL_TRAINING)
    found = succeed("painter", "ablate", *words, "--json", store=tiny_run.store).json
    rules, full = ["none", "overlay", "warp"], "render+lidar+warp"
    assert list(found["tables"]["skips"]) == [*rules, full, f"{full}, no skips"]
    assert list(found["tables"]["fusion"]) == [*rules, full, f"{full}, direct"]
    shown = {label for rows in found["tables"].values() for label in rows.values()}
    assert set(found["painters"]) == shown
    assert {one["total"]["num_pairs"] for one in found["painters"].values()} == {2}
    assert all(Path(path).is_file() for path in found["weights"].values())
    assert "no skips" in succeed("painter", "ablate", *words, store=tiny_run.store).out
