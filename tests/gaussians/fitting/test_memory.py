"""A fit is planned into the memory that is allowed."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.fitting.config import DensificationConfig, FitConfig
from lidarpainter_models.gaussians.fitting.memory import planned_memory
from lidarpainter_models.gaussians.fitting.plan import plan_fit
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet

CONFIG = FitConfig(
    steps=1500,
    initialisation=InitialisationConfig(num_gaussians=55_000),
    densification=DensificationConfig(budget=80_000),
)


def planned(world, config):
    return planned_memory(world.observations, config, world.scene.sky.layout).of_process


def limited(world, memory_bytes, config=CONFIG, **start):
    """The settings of a plan within so much memory."""
    config, cpu = replace(config, memory_bytes=memory_bytes), torch.device("cpu")
    return plan_fit(world.observations, config, device=cpu, **start).settings


def test_what_fits_stays_as_it_is(world):
    enough = planned(world, CONFIG)
    expected = plan_fit(world.observations, CONFIG, device=torch.device("cpu")).settings
    assert limited(world, enough) == replace(expected, memory_bytes=enough)


@pytest.mark.parametrize("share", [0.9, 0.5])
def test_less_memory_gives_fewer_gaussians_that_fit_into_it(world, share):
    few = replace(CONFIG, densification=replace(CONFIG.densification, budget=1))
    none = planned(world, replace(few, initialisation=replace(few.initialisation, num_gaussians=1)))
    allowed = int(none + share * (planned(world, CONFIG) - none))
    config = limited(world, allowed)
    assert 0.99 * share < config.densification.budget / CONFIG.densification.budget <= share
    assert config.initialisation.num_gaussians <= config.densification.budget
    assert planned(world, config) <= allowed


def test_a_start_above_the_budget_is_planned_too(world):
    many = replace(CONFIG, initialisation=InitialisationConfig(num_gaussians=160_000))
    allowed = (planned(world, CONFIG) + planned(world, many)) // 2
    config = limited(world, allowed, many)
    assert config.densification.budget == CONFIG.densification.budget
    assert 115_000 < config.initialisation.num_gaussians <= 120_000
    assert planned(world, config) <= allowed


def test_a_fit_of_one_gaussian_fits_or_is_refused(world):
    one = replace(
        CONFIG,
        initialisation=InitialisationConfig(num_gaussians=1),
        densification=DensificationConfig(budget=1),
    )
    enough = planned(world, one)
    assert limited(world, enough, one).densification.budget == 1
    with pytest.raises(ConfigError, match="takes at least"):
        limited(world, enough - 1, one)


def test_a_limit_that_holds_no_fit_is_refused_with_what_it_takes(world):
    with pytest.raises(ConfigError, match=r"memory 0.1 GB: this fit takes at least 0\.\d GB"):
        limited(world, 100_000_000)


def test_a_start_is_not_made_smaller(world):
    start = GaussianSet.empty(sh_degree=1)
    columns = {
        name: value.new_zeros(100_000, *value.shape[1:]) for name, value in start.columns().items()
    }
    start = world.scene.with_gaussians(GaussianSet(**columns))
    with pytest.raises(ConfigError, match="takes at least"):
        limited(world, planned(world, CONFIG) - 10_000_000, start=start)
