from dataclasses import replace

import pytest

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import (
    START_SHARE,
    DensificationConfig,
    EffortConfig,
    FitConfig,
    continuation,
)
from lidarpainter_models.gaussians.fitting.fit import HALF_STEP, steps_within, work_of
from lidarpainter_models.gaussians.fitting.learning_rates import COLOUR_LOOKS, LearningRates
from lidarpainter_models.gaussians.fitting.plan import planned_settings
from lidarpainter_models.gaussians.fitting.seen_surface import SeenSurface

SURFACE = SeenSurface(
    num_pixels=300_000.0, num_detailed=200_000.0, whole_views=2.5, groups=((0,), (1,))
)
CONFIG = FitConfig(effort=EffortConfig(looks=100, gaussians_per_pixel=0.5))


def test_numbers_left_open_follow_what_is_seen():
    planned = planned_settings(CONFIG, SURFACE)
    assert planned.steps == 250
    assert planned.densification.budget == 100_000
    assert planned.initialisation.num_gaussians == round(START_SHARE * 100_000)
    assert planned.learning_rates == CONFIG.learning_rates.over(100)
    longer = replace(SURFACE, num_detailed=800_000.0, whole_views=10.0)
    assert planned_settings(CONFIG, longer).steps == 1000
    assert planned_settings(CONFIG, longer).densification.budget == 400_000


def test_numbers_that_are_set_stay():
    config = replace(CONFIG, steps=7, densification=DensificationConfig(budget=900))
    planned = planned_settings(config, SURFACE)
    assert (planned.steps, planned.densification.budget) == (7, 900)
    assert planned.initialisation.num_gaussians == round(START_SHARE * 900)
    assert planned_settings(planned, SURFACE) == planned


def test_views_of_nothing_but_sky_still_make_a_plan():
    nothing = SeenSurface(num_pixels=0.0, num_detailed=0.0, whole_views=0.0, groups=((0,),))
    planned = planned_settings(CONFIG, nothing)
    assert (planned.steps, planned.densification.budget) == (1, 1)


def test_going_on_has_its_own_looks_and_the_same_size():
    planned = planned_settings(continuation(CONFIG, looks=20), SURFACE)
    assert (planned.steps, planned.densification.budget) == (50, 100_000)


def test_colours_move_no_further_in_a_longer_fit():
    rates = LearningRates()

    def way(looks):
        return sum(rates.over(looks).at("sh_dc", step / looks) for step in range(round(looks)))

    assert way(COLOUR_LOOKS / 2) == pytest.approx(way(COLOUR_LOOKS) / 2, rel=0.01)
    assert way(COLOUR_LOOKS * 10) == pytest.approx(way(COLOUR_LOOKS), rel=0.01)
    assert replace(rates.over(COLOUR_LOOKS * 10), sh_dc=rates.sh_dc) == rates


@pytest.mark.parametrize("name", ["looks", "gaussians_per_pixel"])
def test_no_effort_is_refused(name):
    with pytest.raises(ConfigError, match="must be positive"):
        EffortConfig(**{name: 0.0})


@pytest.mark.parametrize("half", [0.0, 0.3, 1.0])
def test_steps_at_half_size_count_for_what_they_cost(half):
    config = FitConfig(steps=1000, half_resolution=half)
    smaller = round(1000 * half)
    assert work_of(smaller, config) == pytest.approx(HALF_STEP * smaller)
    assert work_of(1000, config) - work_of(smaller, config) == 1000 - smaller


@pytest.mark.parametrize("step", [100, 250, 600])
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_as_many_steps_follow_as_there_is_work_for(step, share):
    config = FitConfig(steps=1000, half_resolution=0.5)
    work = share * (work_of(1000, config) - work_of(step, config))
    steps = steps_within(work, step, config)
    found = work_of(steps, config, steps) - work_of(step, config, steps)
    assert found == pytest.approx(work, abs=1.0)


def test_without_work_to_be_done_the_steps_end_where_they_are():
    config = FitConfig(steps=1000, half_resolution=0.5)
    assert [steps_within(-9.0, step, config) for step in (100, 600)] == [100, 600]
