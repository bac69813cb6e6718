"""Discriminators and their losses, against answers worked out by hand."""

import pytest
import torch
from torch import nn

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.adversarial import (
    DiscriminatorConfig,
    FeatureDiscriminator,
    FrozenFeatures,
    PatchDiscriminator,
    discriminator_hinge_loss,
    discriminator_loss,
    generator_hinge_loss,
    gradient_penalty,
)

SMALL = DiscriminatorConfig(width=8, num_layers=2, num_scales=2)
FEATURE_CHANNELS = (4, 6)


def frozen_features():
    torch.manual_seed(3)
    first, second = nn.Conv2d(3, 4, 3, stride=2), nn.Conv2d(4, 6, 3, stride=2)
    for layer in (first, second):
        layer.requires_grad_(False)

    def extract(images):
        fine = torch.relu(first(images))
        return [fine, torch.relu(second(fine))]

    return FrozenFeatures(extract=extract, channels=FEATURE_CHANNELS)


def noise(seed, batch=4):
    return torch.rand(batch, 3, 24, 32, generator=torch.Generator().manual_seed(seed))


def logits(*values):
    return [torch.tensor(values).view(-1, 1, 1, 1)]


@pytest.fixture(params=["patches", "features"])
def discriminator(request):
    features = frozen_features()
    torch.manual_seed(0)
    if request.param == "features":
        return FeatureDiscriminator(features, SMALL)
    return PatchDiscriminator(SMALL)


def test_hinge_values_are_those_worked_out_by_hand():
    # true: 0 at 2, 0.5 at 0.5; painted: 0 at -3, 1.5 at 0.5
    loss = discriminator_hinge_loss(logits(2.0, 0.5), logits(-3.0, 0.5))
    assert float(loss) == pytest.approx(0.5 * (0 + 0.5) + 0.5 * (0 + 1.5))
    assert float(generator_hinge_loss(logits(2.0, -1.0))) == pytest.approx(-0.5)
    both = discriminator_hinge_loss(logits(2.0) + logits(0.0), logits(-2.0) + logits(0.0))
    assert float(both) == pytest.approx((0 + 2) / 2)  # one scale is sure, the other knows nothing


def test_a_sure_discriminator_has_no_gradient_left_but_the_painter_has():
    true, painted = (torch.tensor([[[[value]]]], requires_grad=True) for value in (1.5, -1.5))
    discriminator_hinge_loss([true], [painted]).backward()
    assert float(true.grad) == float(painted.grad) == 0
    painted.grad = None
    generator_hinge_loss([painted]).backward()
    assert float(painted.grad) == -1


def test_r1_of_a_linear_discriminator_is_the_square_of_its_weights():
    weight = torch.randn(3, 24, 32, generator=torch.Generator().manual_seed(1))

    def linear(images):
        return [(images * weight).sum(dim=(1, 2, 3)).view(-1, 1, 1, 1)]

    expected = float(weight.square().sum())
    assert float(gradient_penalty(linear, noise(0))) == pytest.approx(expected, rel=1e-5)

    def twice_and_half(images):  # the mean of two scales: 1.25 times as steep
        return [2 * linear(images)[0], 0.5 * linear(images)[0]]

    steep = float(gradient_penalty(twice_and_half, noise(0)))
    assert steep == pytest.approx(1.25**2 * expected, rel=1e-5)


def test_every_convolution_that_is_trained_has_unit_spectral_norm(discriminator):
    discriminator.train()
    for _ in range(50):
        discriminator(noise(0))  # each call is one power iteration
    discriminator.eval()
    trained = [
        module
        for module in discriminator.modules()
        if isinstance(module, nn.Conv2d) and hasattr(module, "parametrizations")
    ]
    expected = SMALL.num_scales * (SMALL.num_layers + 1)
    if isinstance(discriminator, FeatureDiscriminator):
        expected = 2 * len(FEATURE_CHANNELS)
    assert len(trained) == expected
    for layer in trained:
        largest = torch.linalg.matrix_norm(layer.weight.detach().flatten(1), ord=2)
        assert float(largest) == pytest.approx(1.0, abs=0.02)


def test_features_stay_frozen_and_let_gradients_through():
    judge = FeatureDiscriminator(frozen_features(), SMALL)
    painted = noise(1).requires_grad_(True)
    generator_hinge_loss(judge(painted)).backward()
    assert float(painted.grad.abs().max()) > 0
    assert {name.split(".")[0] for name, _ in judge.named_parameters()} == {"heads"}


def test_the_painter_gets_no_gradient_from_the_discriminators_step(discriminator):
    painted = noise(1).requires_grad_(True)
    sum(discriminator_loss(discriminator, noise(0), painted, penalty_weight=2.0)).backward()
    assert painted.grad is None
    _, penalty = discriminator_loss(discriminator, noise(0), painted, penalty_weight=0)
    assert float(penalty) == 0


@pytest.mark.parametrize("name", ["width", "num_layers", "num_scales"])
def test_impossible_shapes_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        DiscriminatorConfig(**{name: 0})


def test_patches_of_three_layers_see_seventy_pixels():
    torch.manual_seed(0)
    judge = PatchDiscriminator(DiscriminatorConfig(width=2, num_scales=1)).eval()
    seen = torch.rand(1, 3, 128, 128, requires_grad=True)
    (verdict,) = judge(seen)
    verdict[0, 0, 8, 8].backward()
    rows = seen.grad[0].abs().sum(dim=(0, 2)).nonzero()
    assert int(rows.max() - rows.min()) + 1 <= 70
    assert int(rows.max() - rows.min()) + 1 >= 46
