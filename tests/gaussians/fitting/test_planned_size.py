from dataclasses import replace

import pytest

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import EffortConfig, FitConfig, continuation
from lidarpainter_models.gaussians.fitting.seen_surface import START_SHARE, SeenSurface, planned_fit
from lidarpainter_models.gaussians.fitting.settings import DensificationConfig

SURFACE = SeenSurface(num_pixels=200_000.0, whole_views=2.5, groups=((0,), (1,)))
CONFIG = FitConfig(effort=EffortConfig(looks=100, gaussians_per_pixel=0.5))


def test_numbers_left_open_follow_what_is_seen():
    planned = planned_fit(CONFIG, SURFACE)
    assert planned.steps == 250
    assert planned.densification.budget == 100_000
    assert planned.initialisation.num_gaussians == round(START_SHARE * 100_000)
    longer = replace(SURFACE, num_pixels=800_000.0, whole_views=10.0)
    assert planned_fit(CONFIG, longer).steps == 1000
    assert planned_fit(CONFIG, longer).densification.budget == 400_000


def test_numbers_that_are_set_stay():
    config = replace(CONFIG, steps=7, densification=DensificationConfig(budget=900))
    planned = planned_fit(config, SURFACE)
    assert (planned.steps, planned.densification.budget) == (7, 900)
    assert planned.initialisation.num_gaussians == round(START_SHARE * 900)
    assert planned_fit(planned, SURFACE) == planned


def test_views_of_nothing_but_sky_still_make_a_plan():
    nothing = SeenSurface(num_pixels=0.0, whole_views=0.0, groups=((0,),))
    planned = planned_fit(CONFIG, nothing)
    assert (planned.steps, planned.densification.budget) == (1, 1)


def test_going_on_has_its_own_looks_and_the_same_size():
    planned = planned_fit(continuation(CONFIG, looks=20), SURFACE)
    assert (planned.steps, planned.densification.budget) == (50, 100_000)


@pytest.mark.parametrize("name", ["looks", "gaussians_per_pixel"])
def test_no_effort_is_refused(name):
    with pytest.raises(ConfigError, match="must be positive"):
        EffortConfig(**{name: 0.0})
