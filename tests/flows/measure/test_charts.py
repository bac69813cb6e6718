"""What a chart draws and says of points that are known."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from toy_store import TOY_SCENE, write_toy_scene

from catalog.errors import CatalogError, ConflictError
from catalog.points import Point
from catalog.store import open_store
from flows.cli import measure
from flows.fleet.asked_sequences import wishes
from flows.fleet.manifest import Manifest, Source
from flows.measure import stress, sweep
from flows.measure.chart import chart_of, sizes_of
from flows.measure.configurations import chart_ways, size_factors
from flows.measure.figures import LANES, qualities
from flows.measure.stress import SEEDS_IN_DOUBT, Trial, in_doubt, stress_of
from flows.measure.sweep import run_sweep, was_asked
from flows.overrides import with_overrides
from flows.presets import PRESETS, preview
from lidarpainter_models.errors import SceneError

SCENES = ("synthetic/street-0001", "pandaset/002")
GAINS = {"preset": 0.0, "first-fit": -1.0, "steps-x2": 0.3, "steps-x0.5": -0.4, "warp": -0.6}
COSTS = {"preset": 200, "first-fit": 90, "steps-x2": 390, "steps-x0.5": 120, "warp": 230}


def point(scene, configuration, seed, psnr, cpu_seconds, num_gaussians=80_000):
    metrics = {("recorded", "recorded", "psnr"): psnr + 0.02 * seed}
    for number, lane in enumerate(LANES):
        metrics["depth", lane, "depth_within_5_percent"] = 0.9 + 0.01 * number
        if scene.startswith("synthetic"):
            metrics["truth", lane, "psnr"] = psnr - 3 + number
    cost = {
        "seconds": cpu_seconds / 2,
        "cpu_seconds": cpu_seconds + seed,
        "peak_memory_bytes": 1.4e9,
        "num_gaussians": num_gaussians,
        "scene_bytes": 100.0 * num_gaussians,
    }
    return Point(
        scene=scene,
        configuration=configuration,
        seed=seed,
        run_id=f"{scene}-{configuration}-{seed}",
        cost=cost,
        metrics=metrics,
    )


def painted_points(gains, seeds=range(1)):
    """Points of scenes, painted and not: what painting gains each in dB, by its name."""
    return [
        point(scene, way, seed, 25.0 + (gain if way == "painted" else 0.0), 100)
        for scene, gain in gains.items()
        for way in ("painted", "unpainted")
        for seed in seeds
    ]


def trials_of(cause, *levels, dataset="stress"):
    """Trials of a cause on the first scene."""
    named = {level: f"{dataset}/{cause}-{level}" for level in levels}
    return [
        Trial(scene=SCENES[0], cause=cause, level=float(level), spoilt=spoilt)
        for level, spoilt in named.items()
    ]


@pytest.fixture
def points():
    return [
        point(scene, name, seed, 28.0 + gain, COSTS[name])
        for scene in SCENES
        for name, gain in GAINS.items()
        for seed in range(3)
    ]


def test_a_quality_is_the_mean_of_its_numbers_or_unknown():
    found = qualities(point(SCENES[0], "preset", 0, 28.0, 100).metrics)
    assert found["recorded_psnr"] == 28.0
    assert found["aside_psnr"] == pytest.approx(25 + 1.5)
    assert found["aside_depth"] == pytest.approx(0.915)
    assert "recorded_lpips" not in found
    assert "aside_psnr" not in qualities(point(SCENES[1], "preset", 0, 28.0, 100).metrics)


def test_fronts_and_what_beats_the_preset_are_said_in_words(points, tmp_path):
    says = chart_of(points, tmp_path)["says"]
    recorded = next(one for one in says if one.startswith("pandaset/002, PSNR of held-out"))
    assert "front first-fit, steps-x0.5, preset, steps-x2" in recorded
    assert "warp" not in recorded
    beaten = [one for one in says if "faster and better" in one]
    assert all(one.endswith(": nothing") for one in beaten)
    better = [*points, *(point(SCENES[1], "overlay", seed, 29.0, 50) for seed in range(3))]
    says = chart_of(better, tmp_path)["says"]
    assert any("pandaset/002, PSNR" in one and one.endswith(": overlay") for one in says)


def test_pictures_hold_every_point(points, tmp_path):
    result = chart_of(points, tmp_path / "new" / "folder")
    svg, png, page = result["pictures"]
    assert Path(svg).read_text().count("<use") > len(points) / 3  # a mark for each mean at least
    drawn = cv2.imread(png)
    assert drawn.shape[1] > drawn.shape[0] / 2
    assert drawn.std() > 10
    html = Path(page).read_text().replace("\\u002f", "/")
    for name in (*GAINS, *SCENES, "Gaussians"):
        assert name in html
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="?(https?:)?//', html)


def test_the_same_points_draw_the_same_file(points, tmp_path):
    first, second = (chart_of(points, tmp_path / name)["pictures"][0] for name in "ab")
    assert Path(first).read_bytes() == Path(second).read_bytes()


def test_each_level_is_held_against_the_one_before(tmp_path):
    factor = size_factors(preview(SCENES[0]))[0]
    points = [
        point(SCENES[0], level.name, seed, psnr, 100 + 10 * number, 20_000 * 2**number)
        for number, (level, psnr) in enumerate(
            zip(factor.levels, (24.0, 26.0, 27.0, 27.0, 26.9), strict=True)
        )
        for seed in range(3)
    ]
    result = sizes_of(points, [factor], tmp_path)
    recorded = next(one for one in result["says"] if "held-out" in one)
    assert "gaussians-x0.5 +2, gaussians-x1 +1, gaussians-x2 +0 (within the noise)" in recorded
    assert [path.rsplit("/", 1)[1] for path in result["pictures"]] == [
        "size-gaussians.svg",
        "size-gaussians.png",
    ]


@pytest.mark.parametrize("preset", PRESETS)
def test_one_thing_is_changed_at_a_time_from_what_is_given(preset):
    given = PRESETS[preset](SCENES[0])
    ways, factors = chart_ways(given), size_factors(given)
    names = [way.name for way in ways]
    assert len(set(names)) == len(names) >= 12
    changed = [with_overrides(given, way.settings) for way in ways[1:] if way.painter is None]
    assert sum(one == given for one in changed) == (given.rounds == 1)  # its one round
    halved = next(way for way in ways if way.name == "gaussians-x0.5")
    effort = with_overrides(given, halved.settings).fit.effort
    assert effort.gaussians_per_pixel == given.fit.effort.gaussians_per_pixel / 2
    for factor in factors:
        same = [way.name for way in factor.levels if with_overrides(given, way.settings) == given]
        assert same == [factor.default]


def sweep_of(scene, **changes):
    """A scene in one way, as `chart` asks for it."""
    way = next(way for way in chart_ways(preview(scene)) if way.name == "no-painter")
    source = Source(dataset="stored", scenes=(scene,))
    return Manifest(**{"name": "chart", "source": (source,), "configuration": (way,), **changes})


def test_points_of_a_scene_that_is_not_there_are_not_asked_for(tmp_path):
    store = open_store(tmp_path)
    store.make()
    with pytest.raises(SceneError, match="pandaset/404"):
        run_sweep(sweep_of("pandaset/404"), store, workers=1, accept_stale=False, say=print)
    assert not was_asked("chart", store)


@pytest.mark.parametrize(
    ("other", "left"),
    [({"fit_seeds": (0, 7)}, "1 of 2"), ({"set": ("fit.steps=9",)}, "0 of 2"), ({}, None)],
)
def test_a_sweep_that_another_took_over_is_refused(tmp_path, monkeypatch, other, left):
    write_toy_scene(tmp_path)
    store, asked = open_store(tmp_path), {"fit_seeds": (0, 1)}

    def another_asks(ledger, *_):
        ledger.ask(wishes(sweep_of(TOY_SCENE, **(asked | other)), Path()))

    monkeypatch.setattr("flows.measure.sweep.run_workers", another_asks)
    problem = CatalogError if left is None else ConflictError
    said = "2 of 2 points are not done" if left is None else f"chart in .*: another .*, {left} are"
    with pytest.raises(problem, match=said):
        run_sweep(sweep_of(TOY_SCENE, **asked), store, workers=1, accept_stale=False, say=print)


def test_stress_says_where_painting_hurts(tmp_path):
    scene, trials = SCENES[0], trials_of("beams", "32", "16", "8", dataset="synthetic")
    names = [scene, *(trial.spoilt for trial in trials)]
    points = painted_points(dict(zip(names, (2.0, 1.5, 0.8, -0.4), strict=True)), range(2))
    result = stress_of(points, trials, tmp_path)
    told = next(one for one in result["says"] if one.startswith("beams"))
    assert "gains +2.00 as recorded, -0.40 at 8 beams; halved at 16, hurts at 8" in told
    assert result["says"][-1].endswith(
        "painting costs most -0.40 (beams, " + scene + " at 8 beams)"
    )
    assert result["says"][-2].endswith("painting costs more than 0.1 dB at 1 of 3 levels")
    curve = next(one for one in result["curves"] if one["quality"] == "recorded_psnr")
    assert curve["levels"] == ["none", "32", "16", "8"]
    assert curve["unpainted"] == pytest.approx([25, 25, 25, 25], abs=1)
    assert curve["painted"][-1] - curve["unpainted"][-1] == pytest.approx(-0.4)
    assert all(Path(path).stat().st_size > 5_000 for path in result["pictures"])
    lines = Path(result["table"]).read_text().splitlines()
    head, _, as_recorded, beams = ([cell.strip() for cell in line.split("|")] for line in lines)
    column = head.index(f"{scene}: PSNR of held-out views, dB")
    assert (as_recorded[1], as_recorded[column]) == ("as recorded", "27.0, +2.00")
    assert beams[1] == "beams, 32 16 8 beams"
    assert beams[column] == "24.6, +1.50 +0.80 -0.40"


def test_levels_at_which_painting_seems_to_hurt_are_given_more_seeds():
    gains = {"stress/beams-8": -0.15, "stress/beams-4": -0.05}
    points = painted_points(gains)
    points += painted_points({"stress/beams-1": -0.15}, range(SEEDS_IN_DOUBT))
    assert in_doubt(points, trials_of("beams", "8", "4", "1")) == ["stress/beams-8"]


def test_more_seeds_of_doubted_levels_join_all_other_points(tmp_path, monkeypatch):
    gains = {SCENES[0]: 0.2, "stress/beams-8": -0.15, "stress/beams-4": 0.1}
    asked, shown = [], []

    def made(sweep, **_):
        asked.append(sweep)
        return [
            point(name, way.name, seed, 25.0 + gains[name] * (way.name == "painted"), 100)
            for name in sweep.source[0].scenes
            for way in sweep.configuration
            for seed in sweep.fit_seeds
        ]

    monkeypatch.setattr("catalog.store.existing_store", lambda: None)
    monkeypatch.setattr(stress, "trials_of", lambda *_: trials_of("beams", "8", "4"))
    monkeypatch.setattr(stress, "spoil_scenes", lambda *_: None)
    monkeypatch.setattr(sweep, "was_asked", lambda *_: True)
    monkeypatch.setattr(sweep, "foretold", lambda *_: "nothing")
    monkeypatch.setattr(measure, "_made", made)
    monkeypatch.setattr(measure, "_show", lambda result, **_: shown.append(result))
    measure.stress([SCENES[0]], tmp_path)
    first, again = asked
    assert (again.source[0].scenes, again.fit_seeds) == (("stress/beams-8",), (1, 2))
    assert first.name != again.name  # a fleet forgets what it is no longer asked for
    drawn = {(one["scene"], one["configuration"], one["seed"]) for one in shown[0]["points"]}
    assert len(drawn) == len(shown[0]["points"]) == 3 * 2 + 2 * 2
    assert any("at 1 of 2 levels" in line for line in shown[0]["says"])


def test_stress_says_from_which_level_on_a_cause_is_noticed(tmp_path):
    scene = SCENES[0]
    said = {
        "none": ("camera faults: left looks 0.3 degrees up.",),
        "10": ("camera faults: left looks 0.4 degrees up.",),
        "50": ("camera faults: left looks 0.3 degrees up; front is 48 ms late.",),
    }
    trials = trials_of("clock", "10", "50")
    names = [scene, *(trial.spoilt for trial in trials)]
    points = [
        replace(point(name, way, 0, 25.0, 100), suspicions=suspicions)
        for name, suspicions in zip(names, said.values(), strict=True)
        for way in ("painted", "unpainted")
    ]
    told = f"clock, {scene}: noticed from 50 ms on: camera faults: front is 48 ms late"
    assert told in stress_of(points, trials, tmp_path)["says"]
    assert f"clock, {scene}: not noticed" in stress_of(points[:4], trials, tmp_path)["says"]
