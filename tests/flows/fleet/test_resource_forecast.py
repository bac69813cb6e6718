"""The forecast learns from attempts what a sequence takes, and says how far off it was."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from flows.fleet.asked_sequences import Asked
from flows.fleet.resource_forecast import KEPT_BYTES, ResourceForecast, forecast_error

START = datetime(2026, 11, 22, tzinfo=UTC)


def street(seed=1, *, frames=12, steps=400, width_px=320):
    return Asked(
        dataset="synthetic",
        sequence=f"street-{seed:04d}",
        seed=seed,
        frames=(0, frames),
        width_px=width_px,
        preset="preview",
        settings=(f"fit.steps={steps}", f"observation.width_px={width_px}"),
    )


def attempt(asked, number):
    """What it would take where costs are other sums of its size than those that are planned by."""
    effort = ResourceForecast([], []).effort(asked)
    parameters, street = asked.parameters, asked.street
    pixels = float(parameters.observation.width_px) ** 2
    views = street.num_frames * pixels
    steps = (parameters.fit.steps + parameters.rounds * 100 * street.num_frames / 12) * pixels
    drawn = street.num_frames * len(street.cameras) * float(street.width_px) ** 2
    cpu_seconds = 25 + 0.8 * street.num_frames + 6e-7 * steps + 3e-6 * views + 3e-6 * drawn
    return {
        "cause": "done",
        "effort": effort.to_json(),
        "ended_at": START + timedelta(minutes=number),
        "worker": "elsewhere:1",
        "seconds": 2.0 * cpu_seconds,
        "cpu_seconds": cpu_seconds,
        "compile_seconds": 0.0,
        "peak_memory_bytes": 6e8 + 30 * views,
        "num_bytes": 1e6 + 14 * views,
        "predicted_cpu_seconds": None,
    }


@pytest.fixture
def past():
    asked = [
        street(frames=frames, steps=steps, width_px=width_px)
        for frames in (6, 12, 28)
        for steps in (200, 800)
        for width_px in (160, 480)
    ]
    return [attempt(one, number) for number, one in enumerate(asked)]


def test_where_nothing_is_known_nothing_is_said():
    assert ResourceForecast([], []).predict(street()).seconds is None
    assert set(ResourceForecast([], []).predict(street()).facts().values()) == {None}


def test_a_sequence_like_none_before_is_predicted(past):
    asked = street(frames=20, steps=500, width_px=320)
    true = attempt(asked, 0)
    prediction = ResourceForecast(past, []).predict(asked)
    assert prediction.cpu_seconds == pytest.approx(true["cpu_seconds"], rel=0.25)
    assert prediction.seconds == pytest.approx(2.0 * prediction.cpu_seconds)
    assert prediction.memory_bytes == pytest.approx(true["peak_memory_bytes"], rel=0.25)
    assert prediction.num_bytes == pytest.approx(true["num_bytes"], rel=0.25)


def test_what_another_version_wrote_is_left_out(past):
    old = {**past[0], "effort": '{"views": 3.0, "steps": 400}', "cpu_seconds": 1e6}
    asked = street(frames=20)
    assert ResourceForecast([old, *past], []).predict(asked) == ResourceForecast(past, []).predict(
        asked
    )


def test_one_attempt_predicts_its_like(past):
    prediction = ResourceForecast(past[:1], []).predict(street(frames=6, steps=200, width_px=160))
    assert prediction.cpu_seconds == pytest.approx(past[0]["cpu_seconds"], rel=0.01)


def test_small_images_do_not_say_that_large_ones_take_tens_of_gigabytes():
    """Four attempts at 160 pixels, whose memory is nearly all the process's."""
    small = [attempt(street(frames=20, width_px=160), number) for number in range(4)]
    past = [{**row, "peak_memory_bytes": 0.9e9 + 1e7 * number} for number, row in enumerate(small)]
    large = ResourceForecast(past, []).predict(street(frames=28, width_px=960))
    assert 1e9 < large.memory_bytes < 4e9


def test_a_scene_that_is_stored_is_not_drawn_again():
    rows = [{"scene_id": "synthetic/street-0001", "num_views": 12, "cameras": ["front_camera"]}]
    one = street().model_copy(update={"cameras": ("front_camera",)})
    drawn, stored = ResourceForecast([], []).effort(one), ResourceForecast([], rows).effort(one)
    assert drawn.cpu_seconds > stored.cpu_seconds + 1


def test_views_that_cannot_be_counted_are_not_guessed():
    log = Asked(dataset="pandaset", sequence="002", root="/logs", preset="preview")
    assert ResourceForecast([], []).effort(log) is None
    row = {"scene_id": "pandaset/002", "num_views": 480, "cameras": ["a", "b", "c", "d", "e", "f"]}
    every = ResourceForecast([], [row]).effort(log)
    front = ResourceForecast([], [row]).effort(log.model_copy(update={"cameras": ("a",)}))
    assert every.num_bytes - KEPT_BYTES == pytest.approx(6 * (front.num_bytes - KEPT_BYTES))


def test_the_error_counts_what_was_predicted_and_computed(past):
    assert forecast_error(past) is None
    wrong = [{**row, "predicted_cpu_seconds": row["cpu_seconds"] * 1.2} for row in past]
    assert forecast_error(wrong) == pytest.approx(0.2)
    recalled = {**wrong[0], "effort": None, "cpu_seconds": 1.0}
    assert forecast_error([*wrong, recalled]) == pytest.approx(0.2)


def test_compiling_kernels_is_no_part_of_a_sequence(past):
    first = {**past[0], "cpu_seconds": past[0]["cpu_seconds"] + 200.0, "compile_seconds": 200.0}
    expected = ResourceForecast(past, []).predict(street(frames=20)).cpu_seconds
    found = ResourceForecast([first, *past[1:]], []).predict(street(frames=20)).cpu_seconds
    assert found == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(5))
def test_a_fleet_on_a_busy_machine_is_predicted_by_its_end(seed):
    """Fifteen sequences of several shapes, one after the other.

    Others on the machine make CPU seconds up to twice as long, by a factor that drifts, and wall
    time up to four times; each attempt is off by 8 % by itself; the first one compiles kernels.
    """
    generator = np.random.default_rng(seed)
    shapes = [(28, 400, 480), (12, 400, 320), (12, 400, 320), (6, 200, 320)]
    attempts, crowd = [], 1.5
    for number in range(15):
        frames, steps, width_px = shapes[generator.integers(len(shapes))]
        asked = street(number + 1, frames=frames, steps=steps, width_px=width_px)
        predicted = ResourceForecast(attempts, []).predict(asked).cpu_seconds
        true = attempt(asked, number)
        crowd = float(np.clip(crowd * generator.lognormal(0.0, 0.1), 1.0, 2.0))
        compiling = 150.0 if number == 0 else 0.0
        own = true["cpu_seconds"] * crowd * generator.lognormal(0.0, 0.08)
        took = {"cpu_seconds": own + compiling, "compile_seconds": compiling}
        wall = (own + compiling) * generator.uniform(1.0, 4.0)
        attempts.append({**true, **took, "seconds": wall, "predicted_cpu_seconds": predicted})
    assert forecast_error(attempts) < 0.25  # the bound of a fleet of fifteen


def test_a_street_drawn_narrower_than_it_may_be_seen_is_counted_as_drawn():
    narrow = street().model_copy(update={"settings": ()})
    as_drawn = narrow.model_copy(update={"settings": ("observation.width_px=320",)})
    assert ResourceForecast([], []).effort(narrow) == ResourceForecast([], []).effort(as_drawn)
