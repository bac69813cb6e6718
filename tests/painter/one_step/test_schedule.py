"""The closed form of the step against diffusers' own scheduler, and its inversion."""

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.one_step.schedule import denoise, denoising_step


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


@pytest.mark.parametrize("timestep", [999, 200, 199])
def test_the_right_noise_gives_the_clean_latent_back(timestep):
    step = denoising_step(timestep)
    clean, latent = draw(0), draw(1)
    noise = (latent.double() - step.signal * clean.double()) / step.noise
    # the noise is rounded to float32 before it is multiplied by up to 14.6
    torch.testing.assert_close(denoise(latent, noise.float(), step), clean, rtol=0, atol=1.5e-5)


@pytest.mark.parametrize(
    ("timestep", "clean", "noise"), [(999, 14.65, 14.61), (200, 1.1518, 0.572), (199, 1.1507, 0.57)]
)
def test_the_facts_of_sd_turbos_schedule(timestep, clean, noise):
    step = denoising_step(timestep)
    assert 1 / step.signal == pytest.approx(clean, abs=0.01)
    assert step.noise / step.signal == pytest.approx(noise, abs=0.01)


def test_a_residual_step_adds_and_half_precision_is_lifted():
    latent, predicted = draw(0).bfloat16(), draw(1).bfloat16()
    actual = denoise(latent, predicted, denoising_step(999), "residual")
    assert torch.equal(actual, latent.float() + predicted.float())
    assert denoise(latent, predicted, denoising_step(999)).dtype == torch.float32


@pytest.mark.parametrize("timestep", [1000, -1])
def test_times_outside_the_schedule_are_refused(timestep):
    with pytest.raises(ConfigError, match=r"timestep must be in \[0, 999\]"):
        denoising_step(timestep)
