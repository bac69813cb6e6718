"""The closed form of the step against diffusers' own scheduler, and its inversion."""

import math

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.one_step.schedule import (
    NoiseSchedule,
    denoise,
    denoising_step,
)


def turbo_scheduler():
    from diffusers import DDPMScheduler

    return DDPMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        num_train_timesteps=1000,
        timestep_spacing="trailing",
        clip_sample=False,
        prediction_type="epsilon",
    )


def draw(seed):
    return torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("timestep", [999, 200, 199])
def test_one_step_is_the_schedulers(timestep):
    scheduler = turbo_scheduler()
    scheduler.set_timesteps(timesteps=[timestep])
    latent, predicted = draw(0), draw(1)
    expected = scheduler.step(predicted, timestep, latent).prev_sample
    actual = denoise(latent, predicted, denoising_step(timestep))
    # relative to sqrt(1 / abar), 14.6 at 999, by which both scale their inputs' rounding
    scale = 1 / denoising_step(timestep).signal
    torch.testing.assert_close(actual / scale, expected / scale, rtol=0, atol=1e-5)


def test_two_steps_are_the_schedulers_apart_from_its_noise():
    scheduler = turbo_scheduler()
    scheduler.set_timesteps(timesteps=[999, 499])
    latent, first, second = draw(0), draw(1), draw(2)
    noise = torch.randn(latent.shape, generator=torch.Generator().manual_seed(7))
    expected = scheduler.step(
        first, 999, latent, generator=torch.Generator().manual_seed(7)
    ).prev_sample
    step = denoising_step(999, 499)
    actual = denoise(latent, first, step) + step.deviation * noise
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)
    expected = scheduler.step(second, 499, expected).prev_sample
    actual = denoise(actual, second, denoising_step(499))
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("timestep", [999, 200, 199])
def test_the_right_noise_gives_the_clean_latent_back(timestep):
    step = denoising_step(timestep)
    clean, latent = draw(0), draw(1)
    noise = (latent.double() - step.signal * clean.double()) / step.noise
    # the noise is rounded to float32 before it is multiplied by up to 14.6
    torch.testing.assert_close(denoise(latent, noise.float(), step), clean, rtol=0, atol=1.5e-5)


def test_the_facts_of_sd_turbos_schedule():
    schedule = NoiseSchedule()
    assert schedule.signal_share(999) == pytest.approx(0.00466, abs=1e-5)
    assert schedule.signal_share(199) == pytest.approx(0.7552, abs=1e-4)
    last = denoising_step(999)
    assert (last.clean, last.current, last.deviation) == (1, 0, 0)
    assert 1 / last.signal == pytest.approx(14.65, abs=0.01)
    assert last.noise / last.signal == pytest.approx(14.61, abs=0.01)
    near = denoising_step(200)
    assert near.signal == pytest.approx(0.8682, abs=1e-4)
    assert near.noise / near.signal == pytest.approx(0.572, abs=1e-3)


def test_the_papers_first_denominator_would_divide_by_zero():
    """Its beta_{t-1}, cumulative, is 0 in the last step; the right denominator is 1 - abar_t."""
    schedule = NoiseSchedule()
    assert 1 - schedule.signal_share(-1) == 0
    # read literally with the betas of single steps it is nearly a residual: Z + z
    betas = [1 - schedule.signal_share(t) / schedule.signal_share(t - 1) for t in (998, 999)]
    first = math.sqrt(1 - betas[0]) * betas[1] / betas[0]
    second = math.sqrt(1 - betas[1]) * betas[0] / betas[1]
    assert (first, second) == (pytest.approx(0.9955, abs=1e-3), pytest.approx(0.9925, abs=1e-3))


def test_a_residual_step_adds_and_half_precision_is_lifted():
    latent, predicted = draw(0).bfloat16(), draw(1).bfloat16()
    actual = denoise(latent, predicted, denoising_step(999), "residual")
    assert torch.equal(actual, latent.float() + predicted.float())
    assert denoise(latent, predicted, denoising_step(999)).dtype == torch.float32


@pytest.mark.parametrize(("timestep", "previous"), [(1000, -1), (5, 5), (3, 4), (0, -2)])
def test_times_outside_the_schedule_are_refused(timestep, previous):
    with pytest.raises(ConfigError):
        denoising_step(timestep, previous)


def test_a_schedule_that_is_none_is_refused():
    with pytest.raises(ConfigError, match="noise schedule"):
        NoiseSchedule(first_beta=0.5, last_beta=0.1)
