"""The wiring: pix2pix-turbo at the start, deterministic, the same however it is computed."""

import dataclasses

import pytest
import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.one_step.assembly import is_adapted, merge_lora
from lidarpainter_models.painter.one_step.config import (
    PAPER,
    PRESETS,
    WITH_REFERENCE,
    OneStepConfig,
)
from lidarpainter_models.painter.one_step.denoiser import widen_first_layer
from lidarpainter_models.painter.one_step.latent_fusion import FusionConfig, LatentFusion

SKIPS = ("skip_conv_1", "skip_conv_2", "skip_conv_3", "skip_conv_4")


def pix2pix_turbo(network, image, text, timestep):
    """The plain wiring, written out: one image, its latent in place of the noise."""
    autoencoder, unet = network.autoencoder, network.denoiser.unet
    encoder, decoder = autoencoder.encoder, autoencoder.decoder.base
    sample = encoder.conv_in(2 * image - 1)
    levels = []
    for block in encoder.down_blocks:
        levels.append(sample)
        sample = block(sample)
    sample = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(encoder.mid_block(sample))))
    mean = autoencoder.quant_conv(sample)[:, :4]
    latent = mean * 0.18215
    predicted = unet(latent, timestep, encoder_hidden_states=text).sample
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    share = float((1 - betas).cumprod(0)[timestep])
    clean = (latent - (1 - share) ** 0.5 * predicted) / share**0.5
    sample = decoder.conv_in(autoencoder.post_quant_conv(clean / 0.18215))
    sample = decoder.mid_block(sample)
    for index, block in enumerate(decoder.up_blocks):
        sample = sample + autoencoder.decoder.skip_convs[index](levels[::-1][index])
        sample = block(sample)
    decoded = decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(sample)))
    return decoded * 0.5 + 0.5


@torch.no_grad()
def narrowed(network):
    """The U-Net with its first layer cut to the first latent, and how it was."""
    layer = network.denoiser.unet.conv_in
    whole = layer.weight
    layer.weight = torch.nn.Parameter(whole[:, :4].contiguous(), requires_grad=False)
    return whole


@pytest.mark.parametrize("timestep", [999, 199])
@torch.no_grad()
def test_trusting_the_render_alone_is_pix2pix_turbo_bit_for_bit(
    timestep, make_network, make_inputs
):
    config = dataclasses.replace(PAPER, timestep=timestep)
    network = make_network(config)
    network.denoiser.unet.conv_in.weight[:, 4:] = 0
    network.fusion.layers[-1].bias.fill_(1000.0)  # a share of exactly one
    images, text = make_inputs()
    # one image at a time: a batch of two may be summed in another order
    actual = network(images, text, encodes_at_once=False)
    narrowed(network)
    expected = pix2pix_turbo(network, images[0], text, timestep)
    assert torch.equal(actual, expected)


@pytest.mark.parametrize("preset", PRESETS)
@torch.no_grad()
def test_nothing_random_is_drawn(preset, make_network, make_inputs):
    network = make_network(PRESETS[preset], has_adapters=True)
    images, text = make_inputs(len(network.config.inputs))
    generator = torch.Generator().manual_seed(3)
    before, own = torch.get_rng_state(), generator.get_state()
    first = network(images, text)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(generator.get_state(), own)
    assert torch.equal(network(images, text), first)
    assert first.shape == images.shape[1:]
    assert bool(first.isfinite().all())


@torch.no_grad()
def test_building_a_network_leaves_the_random_state_alone(make_network):
    before = torch.get_rng_state()
    first = make_network(PAPER, has_adapters=True, seed=4)
    assert torch.equal(torch.get_rng_state(), before)
    again = make_network(PAPER, has_adapters=True, seed=4)
    for one, other in zip(first.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)


@torch.no_grad()
def test_merged_adapters_do_the_same_in_fewer_layers(make_network, make_inputs):
    network = make_network(PAPER, has_adapters=True)
    images, text = make_inputs()
    expected = network(images, text)
    plain = make_network(PAPER)(images, text)
    assert not torch.allclose(expected, plain, atol=1e-2)  # they do something
    num_layers = len(list(network.modules()))
    merge_lora(network)
    actual = network(images, text)
    assert not any(is_adapted(module) for module in network.modules())
    assert len(list(network.modules())) < num_layers / 2
    assert not any("lora" in name for name, _ in network.named_parameters())
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("skips", ["render", "fused", "none"])
@torch.no_grad()
def test_encoding_at_once_and_one_by_one_agree(skips, make_network, make_inputs):
    network = make_network(dataclasses.replace(WITH_REFERENCE, skips=skips))
    if skips != "none":
        for conv in network.autoencoder.decoder.skip_convs:
            conv.weight.normal_(std=0.1, generator=torch.Generator().manual_seed(0))
    images, text = make_inputs(3, batch=2)
    at_once = network(images, text)
    one_by_one = network(images, text, encodes_at_once=False)
    torch.testing.assert_close(at_once, one_by_one, rtol=1e-4, atol=1e-4)
    # views of a batch do not see each other
    alone = network(images[:, 1:], text[1:])
    torch.testing.assert_close(at_once[1:], alone, rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_fused_skips_with_the_whole_share_are_the_renders(make_network, make_inputs):
    images, text = make_inputs()
    found = []
    for skips in ("render", "fused"):
        network = make_network(dataclasses.replace(PAPER, skips=skips))
        network.fusion.layers[-1].bias.fill_(1000.0)
        for conv in network.autoencoder.decoder.skip_convs:
            conv.weight.normal_(std=0.1, generator=torch.Generator().manual_seed(0))
        found.append(network(images, text))
    torch.testing.assert_close(found[0], found[1], rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_lidar_changes_the_image_only_through_fusion_at_the_start(make_network, make_inputs):
    """With random first-layer weights the U-Net sees LiDAR; with zeros and no fusion it cannot."""
    images, text = make_inputs()
    other = images.clone()
    other[1] = 1 - other[1]
    network = make_network(dataclasses.replace(PAPER, fusion=None))
    assert not torch.equal(network(images, text), network(other, text))
    network.denoiser.unet.conv_in.weight[:, 4:] = 0
    assert torch.equal(network(images, text), network(other, text))


@pytest.mark.parametrize(
    ("config", "channels"),
    [
        (OneStepConfig(inputs=("render",), fusion=None), 4),
        (OneStepConfig(inputs=("lidar",), fusion=None), 4),
        (OneStepConfig(inputs=("render", "warp")), 8),
        (dataclasses.replace(PAPER, denoiser_sees="fused"), 4),
    ],
)
@torch.no_grad()
def test_ablations_run(config, channels, make_network, make_inputs):
    network = make_network(config)
    assert network.denoiser.unet.conv_in.in_channels == channels
    images, text = make_inputs(len(config.inputs))
    assert network(images, text).shape == images[0].shape


@pytest.mark.parametrize(("inputs", "channels"), [(2, 10), (3, 14)])
@torch.no_grad()
def test_masks_are_two_more_channels(inputs, channels, make_network, make_inputs):
    names = ("render", "lidar", "warp")[:inputs]
    network = make_network(OneStepConfig(inputs=names, masks=True))
    assert network.denoiser.unet.conv_in.in_channels == channels
    images, text = make_inputs(inputs)
    empty, full = torch.zeros(1, 2, 8, 16), torch.ones(1, 2, 8, 16)
    found = [network(images, text, masks) for masks in (empty, full)]
    assert not torch.equal(*found)


def test_the_last_layer_and_the_step_stay_in_float32(make_inputs):
    from random_diffusion import random_network
    from tiny_diffusion import TINY

    network = random_network(PAPER, architecture=TINY, has_adapters=True)
    images, text = make_inputs()
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        output = network(images, text)
    types = {parameter.dtype for parameter in network.denoiser.unet.conv_out.parameters()}
    assert types == {torch.float32}
    assert network.denoiser.unet.conv_in.weight.dtype == torch.bfloat16
    assert output.dtype == torch.float32
    seen = network.denoiser(torch.zeros(1, 8, 8, 16), text)
    assert seen.dtype == torch.float32
    assert not torch.equal(seen, seen.bfloat16().float())  # nothing rounded it on the way


def test_a_first_layer_grows_by_zeros_or_copies():
    weight = torch.randn(3, 4, 3, 3, generator=torch.Generator().manual_seed(0))
    zeros = widen_first_layer(weight, 10, "zero")
    assert torch.equal(zeros[:, :4], weight)
    assert bool((zeros[:, 4:] == 0).all())
    copied = widen_first_layer(weight, 14, "copy")
    for first in (0, 4, 8):
        assert torch.equal(copied[:, first : first + 4], weight)
    assert bool((copied[:, 12:] == 0).all())


@pytest.mark.parametrize(("inputs", "channels"), [(2, 1), (2, 4), (3, 1), (3, 4)])
def test_fusion_begins_at_the_render_and_shares_sum_to_one(inputs, channels):
    fusion = LatentFusion(FusionConfig(channels=channels), inputs)
    latents = torch.randn(inputs, 2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    shares = fusion(latents)
    assert shares.shape == (inputs, 2, channels, 8, 8)
    torch.testing.assert_close(shares.sum(dim=0), torch.ones(2, channels, 8, 8))
    assert float(shares[0].detach().mean()) == pytest.approx(
        0.924 if inputs == 2 else 0.859, abs=1e-3
    )
    shares.square().sum().backward()
    assert float(fusion.layers[-1].weight.grad.abs().sum()) > 0


def test_the_authors_fusion_has_56_parameters():
    fusion = LatentFusion(FusionConfig(kind="as-shipped", channels=4), 2)
    assert sum(parameter.numel() for parameter in fusion.parameters()) == 56


@pytest.mark.parametrize(
    "settings",
    [
        {"inputs": ()},
        {"inputs": ("lidar", "render")},
        {"inputs": ("radar",)},
        {"inputs": ("render",)},
        {"autoencoder": "taesd"},
        {"skips": "fused", "fusion": None},
        {"timestep": 1000},
        {"unet_rank": -1},
        {"unet_rank": 10**9},
    ],
)
def test_wirings_that_cannot_be_are_refused(settings):
    with pytest.raises(ConfigError):
        OneStepConfig(**settings)


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_json(preset):
    import json

    config = PRESETS[preset]
    assert OneStepConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


@pytest.mark.parametrize(
    "change",
    [
        {"autoencoder": "jpeg"},
        {"lidar": []},
        {"colour": 1},
        {"fusion": {"kind": 3}},
        {"timestep": 5000},
    ],
)
def test_settings_of_something_else_are_refused(change):
    with pytest.raises(ConfigError):
        OneStepConfig.from_dict(PAPER.to_dict() | change)
