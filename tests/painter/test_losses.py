"""Every term that painters share, alone, and the paper's sum of them."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.adversarial import DiscriminatorConfig, PatchDiscriminator
from lidarpainter_models.painter.batches import stack_conditions
from lidarpainter_models.painter.losses import (
    PaperLossWeights,
    absolute_loss,
    agreement_mask,
    gradient_loss,
    paper_loss,
    squared_loss,
    structure_loss,
)

TERMS = (absolute_loss, squared_loss, structure_loss, gradient_loss)
WITHOUT_NETWORKS = PaperLossWeights(lpips=0, adversarial=0)


def images(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, 3, 16, 20, generator=generator), torch.rand(
        2, 3, 16, 20, generator=generator
    )


def tenfold_difference(ours, truth):
    """Stands for LPIPS: any distance per image."""
    return 10 * (ours - truth).abs().mean(dim=(1, 2, 3))


@pytest.mark.parametrize("term", TERMS)
def test_equal_images_cost_nothing(term):
    image, _ = images()
    assert abs(float(term(image, image, torch.ones(2, 16, 20)))) < 1e-6


@pytest.mark.parametrize("term", TERMS)
def test_unknown_pixels_neither_cost_nor_pull(term):
    image, target = images()
    image.requires_grad_(True)
    mask = torch.ones(2, 16, 20)
    mask[:, :, 10:] = 0
    loss = term(image, target, mask)
    loss.backward()
    assert float(loss.detach()) > 0
    assert float(image.grad[..., 10:].abs().max()) == 0
    assert float(image.grad[..., :10].abs().max()) > 0
    changed = image.detach().clone()
    changed[..., 10:] = 0
    torch.testing.assert_close(term(changed, target, mask), loss.detach())


@pytest.mark.parametrize("term", TERMS)
def test_a_term_over_no_pixel_is_zero(term):
    image, target = images()
    assert float(term(image, target, torch.zeros(2, 16, 20))) == 0


def test_terms_match_hand_worked_answers():
    image, target = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 2, 2)
    image[:, :, 0, 0] = 0.4
    mask = torch.ones(1, 2, 2)
    assert float(absolute_loss(image, target, mask)) == pytest.approx(0.1)
    assert float(squared_loss(image, target, mask)) == pytest.approx(0.04)
    # one of two horizontal and one of two vertical steps is off by 0.4
    assert float(gradient_loss(image, target, mask)) == pytest.approx(0.4)


def test_agreement_needs_every_valid_warp(make_conditions):
    conditions = make_conditions(4, 4, num_sources=2)
    render = conditions.render_rgb
    far = (render + 0.5) % 1
    valid = torch.zeros(2, 4, 4, dtype=torch.bool)
    valid[:, 0], valid[0, 1] = True, True
    warp = torch.stack([render, far])
    batch = stack_conditions([replace(conditions, warp_rgb=warp, warp_valid=valid)], num_sources=2)
    mask = agreement_mask(batch, 0.03)[0]
    assert float(mask[0].max()) == 0  # the second warp disagrees
    assert float(mask[1].min()) == 1  # only the first is valid, and agrees
    assert float(mask[2:].max()) == 0  # no warp at all


def test_the_papers_weights_are_those_of_the_paper():
    weights = PaperLossWeights()
    found = (weights.lpips, weights.squared, weights.structure, weights.adversarial)
    assert found == (0.2, 0.6, 0.4, 1.0)


def test_the_papers_loss_is_the_weighted_sum_of_its_terms():
    image, target = images()
    mask = torch.ones(2, 16, 20)

    def flat_verdict(seen):
        return [seen.mean(dim=1, keepdim=True), torch.full((2, 1, 1, 1), 0.5)]

    weights = PaperLossWeights()
    loss = paper_loss(
        image, target, mask, weights, lpips=tenfold_difference, discriminator=flat_verdict
    )
    assert float(loss["squared"]) == pytest.approx(float((image - target).square().mean()))
    assert float(loss["structure"]) == float(structure_loss(image, target, mask))
    assert float(loss["lpips"]) == pytest.approx(10 * float((image - target).abs().mean()))
    assert float(loss["adversarial"]) == pytest.approx(-(float(image.mean()) + 0.5) / 2)
    expected = (
        0.2 * loss["lpips"] + 0.6 * loss["squared"] + 0.4 * loss["structure"] + loss["adversarial"]
    )
    assert float(loss["total"]) == pytest.approx(float(expected))


def test_unknown_pixels_reach_neither_lpips_nor_discriminator():
    image, target = images()
    image.requires_grad_(True)
    mask = torch.ones(2, 16, 20)
    mask[:, 8:] = 0
    torch.manual_seed(0)
    judge = PatchDiscriminator(DiscriminatorConfig(width=4, num_layers=1, num_scales=1))
    paper_loss(
        image, target, mask, PaperLossWeights(), lpips=tenfold_difference, discriminator=judge
    )["total"].backward()
    assert float(image.grad[:, :, 8:].abs().max()) == 0
    assert float(image.grad[:, :, :8].abs().max()) > 0


def test_negative_weights_are_refused():
    with pytest.raises(ConfigError, match="structure"):
        replace(WITHOUT_NETWORKS, structure=-0.1)
