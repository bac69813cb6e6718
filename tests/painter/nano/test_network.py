"""The fusion network."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ConfigError, ShapeError
from lidarpainter_models.painter import filters as hulls
from lidarpainter_models.painter.batches import in_planes, stack_conditions
from lidarpainter_models.painter.filters import HULL_MARGIN, fill_push_pull, input_hull
from lidarpainter_models.painter.nano.candidates import build_candidates
from lidarpainter_models.painter.nano.features import painting_features
from lidarpainter_models.painter.nano.network import CELL_PX, NanoConfig, NanoNetwork, PixelNorm
from lidarpainter_models.painter.nano.painter import NanoPainter, without_cells
from lidarpainter_models.painter.selection import load_painter

SMALL = {"widths": (8, 8, 8), "blocks": (1, 1, 1)}


def scrambled(config):
    """A network whose every weight is random, so that nothing is hidden by a zero."""
    network = NanoNetwork(config)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    return network


def test_untrained_network_with_a_high_base_logit_equals_the_warp_painter(make_conditions):
    conditions = make_conditions(33, 50)
    painted = NanoPainter(NanoNetwork(NanoConfig(base_logit=9.0))).paint(conditions).rgb
    expected = load_painter("warp").paint(conditions).rgb
    # the base candidate holds all but 7 exp(-9) of the weight
    assert float((painted - expected).abs().max()) < 0.5 / 255


@pytest.mark.parametrize("half_precision", [False, True])
def test_mix_weights_sum_to_one(half_precision, make_conditions):
    network = scrambled(NanoConfig(**SMALL))
    batch = stack_conditions([make_conditions(seed=1), make_conditions(seed=2)], num_sources=2)
    output = network(batch, ["clear", "clear"], half_precision=half_precision)
    torch.testing.assert_close(output.weights.sum(dim=1), torch.ones(2, 24, 40))
    assert output.weights.shape[1] == len(network.config.candidates) == 8


def test_what_does_not_exist_is_never_chosen(make_conditions):
    network = scrambled(NanoConfig(**SMALL))
    conditions = make_conditions()
    bare = replace(
        conditions,
        lidar_hit=torch.zeros_like(conditions.lidar_hit),
        lidar_rgb=torch.zeros_like(conditions.lidar_rgb),
    )
    with torch.no_grad():
        weights = network(stack_conditions([bare], num_sources=2), ["clear"]).weights[0]
    names = network.config.candidates
    assert float(weights[names.index("lidar_filled")].max()) == 0
    assert float(weights[names.index("warp_1")][~bare.warp_valid[0]].max()) == 0
    assert float(weights[names.index("warp_2")][bare.warp_valid[1]].min()) > 0


@pytest.mark.parametrize(
    ("inputs", "blind_to"),
    [
        ({"render"}, {"lidar_rgb", "warp_rgb", "reference_rgb"}),
        ({"lidar"}, {"render_rgb", "warp_rgb", "reference_rgb"}),
        ({"render", "lidar"}, {"warp_rgb", "reference_rgb"}),
        ({"render", "warp"}, {"lidar_rgb", "reference_rgb"}),
        ({"render", "lidar", "warp"}, {"reference_rgb"}),
        ({"render", "lidar", "reference"}, {"warp_rgb"}),
        ({"lidar", "reference"}, {"render_rgb", "warp_rgb"}),
    ],
)
def test_ablated_network_ignores_what_it_may_not_see(inputs, blind_to, make_conditions):
    network = scrambled(NanoConfig(inputs=frozenset(inputs), **SMALL))
    painter = NanoPainter(network)
    conditions, other = make_conditions(seed=1), make_conditions(seed=2)
    before = painter.paint(conditions)
    for name in ("render_rgb", "lidar_rgb", "warp_rgb", "reference_rgb"):
        changed = painter.paint(replace(conditions, **{name: getattr(other, name)}))
        is_same = torch.equal(changed.rgb, before.rgb)
        assert is_same == (name in blind_to), name


@pytest.mark.parametrize("prompt", ["clear", "foggy"])
def test_a_network_laid_out_in_bfloat16_paints_as_one_converted_on_the_way(prompt, make_conditions):
    network = scrambled(NanoConfig(prompts=("clear", "foggy"), **SMALL))
    batch = stack_conditions([make_conditions()], num_sources=2)
    with torch.no_grad():
        expected = network(batch, [prompt], half_precision=True)
        actual = network.halved()(batch, [prompt])
    # activations are rounded to eight bits at other places
    assert float((actual.rgb - expected.rgb).abs().mean()) < 1e-3
    assert float((actual.log_error - expected.log_error).abs().mean()) < 5e-3
    assert {parameter.dtype for parameter in network.parameters()} == {torch.float32}


def test_the_order_of_channels_in_memory_does_not_change_a_batch_or_a_hull(make_conditions):
    conditions = make_conditions(num_sources=3)
    apart = in_planes(conditions)
    assert torch.equal(apart.warp_rgb, conditions.warp_rgb)
    assert apart.render_rgb[..., 0].is_contiguous()
    for one, other in zip(input_hull(apart), input_hull(conditions), strict=True):
        assert torch.equal(one, other)
    expected = stack_conditions([conditions], num_sources=2)
    actual = stack_conditions([apart], num_sources=2)
    assert torch.equal(actual.render, expected.render)
    assert torch.equal(actual.warp, expected.warp)
    assert actual.warp.is_contiguous()


def test_residual_is_bounded(make_conditions):
    config = NanoConfig(**SMALL)
    network = scrambled(config)
    batch = stack_conditions([make_conditions()], num_sources=2)
    output = network(batch, ["clear"])
    candidates = build_candidates(
        batch, config.inputs, fill_push_pull(batch.lidar, batch.lidar_hit)
    )
    images = torch.stack(candidates.images)
    low, high = (images.amin(dim=0), images.amax(dim=0))
    low, high = low - config.residual_limit, high + config.residual_limit
    assert bool(((output.rgb >= low - 1e-6) & (output.rgb <= high + 1e-6)).all())


def test_a_painter_of_a_reference_needs_one(make_conditions):
    inputs = frozenset({"render", "reference"})
    painter = NanoPainter(scrambled(NanoConfig(inputs=inputs, **SMALL)))
    with pytest.raises(ConfigError, match="sees the nearest recorded image"):
        painter.paint(replace(make_conditions(), reference_rgb=None))


def test_a_composite_shows_the_render_between_lidar_points(make_conditions):
    batch = stack_conditions([make_conditions()], num_sources=2)
    both = frozenset({"render", "lidar"})
    _, filled = painting_features(batch, both, composite=True)
    expected = torch.where(batch.lidar_hit > 0, batch.lidar, batch.render)
    assert torch.equal(filled, expected)
    with pytest.raises(ConfigError, match="composite"):
        NanoConfig(inputs=frozenset({"lidar"}), composite=True)


def test_without_a_mix_the_image_itself_is_predicted(make_conditions):
    batch = stack_conditions([make_conditions()], num_sources=2)
    with torch.no_grad():
        output = scrambled(NanoConfig(mix=False, **SMALL))(batch, ["clear"])
    assert output.weights.shape == (1, 0, 24, 40)
    assert 0 <= float(output.rgb.min()) < float(output.rgb.max()) <= 1
    plain = NanoNetwork(NanoConfig(mix=False, **SMALL))(batch, ["clear"]).rgb
    assert torch.equal(plain, torch.full_like(plain, 0.5))


@pytest.mark.parametrize("skips", [True, False])
def test_without_skips_all_passes_through_the_coarsest_level(skips, make_conditions):
    network = scrambled(NanoConfig(skips=skips, inputs=frozenset({"render"}), **SMALL))
    with torch.no_grad():
        for parameter in network.up_fine.parameters():
            parameter.zero_()
        batch = stack_conditions([make_conditions(64, 64)], num_sources=2)
        inner = network(batch, ["clear"]).weights[..., 16:-16, 16:-16]
    by_place = inner.unflatten(-1, (-1, CELL_PX)).unflatten(-3, (-1, CELL_PX))
    first_cell = by_place[:, :, :1, :, :1]
    is_flat = bool((by_place - first_cell).abs().max() < 1e-6)
    assert is_flat != skips


@pytest.mark.parametrize(("height_px", "width_px"), [(1, 1), (3, 20), (24, 40)])
def test_the_hull_is_the_range_within_nine_pixels(
    height_px, width_px, make_conditions, monkeypatch
):
    monkeypatch.setattr(hulls, "HULL_MARGIN", 0.0)
    conditions = make_conditions(height_px, width_px)
    hull = input_hull(conditions)
    shown = torch.stack([conditions.render_rgb, conditions.lidar_rgb, *conditions.warp_rgb])
    exists = torch.stack([conditions.lidar_hit, *conditions.warp_valid])
    exists = torch.cat([torch.ones_like(exists[:1]), exists])
    for row in range(height_px):
        for column in range(width_px):
            rows = slice(max(row - 4, 0), row + 5)
            columns = slice(max(column - 4, 0), column + 5)
            nearby = shown[:, rows, columns][exists[:, rows, columns]]
            assert torch.equal(hull.lower[row, column], nearby.amin(dim=0))
            assert torch.equal(hull.upper[row, column], nearby.amax(dim=0))


def test_the_painter_shows_no_colour_that_no_input_shows_nearby(make_conditions):
    noise = make_conditions()
    flat = {
        name: torch.full_like(getattr(noise, name), 0.5)
        for name in ("render_rgb", "lidar_rgb", "warp_rgb")
    }
    conditions = replace(noise, **flat)
    network = scrambled(NanoConfig(**SMALL))
    batch = stack_conditions([conditions], num_sources=2)
    output = network(batch, ["clear"]).rgb.detach()
    assert float((output - 0.5).abs().max()) > HULL_MARGIN  # the network alone would
    painted = NanoPainter(network, precision=torch.float32).paint(conditions).rgb
    assert float((painted - 0.5).abs().max()) <= HULL_MARGIN + 1e-6


def test_pixel_norm_in_bfloat16_takes_its_mean_in_float32():
    features = torch.randn(2, 48, 5, 7, generator=torch.Generator().manual_seed(0)).bfloat16()
    norm = PixelNorm(48)
    torch.nn.init.uniform_(norm.gain, 0.5, 2.0, generator=torch.Generator().manual_seed(1))
    exact = norm(features.float())
    # two roundings to eight bits
    torch.testing.assert_close(norm(features).float(), exact, rtol=2**-7, atol=0)


def test_pixel_norm_brings_every_pixel_to_one():
    features = 1e4 * torch.randn(2, 8, 5, 7, generator=torch.Generator().manual_seed(0))
    size = PixelNorm(8)(features).square().mean(dim=1)
    torch.testing.assert_close(size, torch.ones(2, 5, 7))
    assert float(PixelNorm(8)(torch.zeros(1, 8, 2, 2)).detach().abs().max()) == 0


def test_large_weights_cannot_blow_up_the_answer(make_conditions):
    network = scrambled(NanoConfig(**SMALL))
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if "head" not in name and "gain" not in name:
                parameter.mul_(1e3)
        batch = stack_conditions([make_conditions()], num_sources=2)
        output = network(batch, ["clear"], half_precision=True)
    assert bool(output.rgb.isfinite().all())
    assert float(output.log_error.std()) > 0


def test_settings_from_before_normalisation_mean_none():
    settings = NanoConfig(**SMALL).to_dict()
    del settings["normalise"]
    assert not NanoConfig.from_dict(settings).normalise


def test_unknown_prompt_is_refused_in_one_line(make_conditions):
    painter = NanoPainter(NanoNetwork(NanoConfig(**SMALL)))
    with pytest.raises(ConfigError, match="no prompt 'foggy', only: clear") as caught:
        painter.paint(make_conditions(prompt="foggy"))
    assert "\n" not in str(caught.value)


def test_prompts_of_one_batch_are_told_apart(make_conditions):
    network = scrambled(NanoConfig(prompts=("clear", "foggy"), **SMALL))
    batch = stack_conditions([make_conditions(), make_conditions()], num_sources=2)
    rgb = network(batch, ["clear", "foggy"]).rgb
    assert not torch.equal(rgb[0], rgb[1])


@pytest.mark.parametrize(
    "settings",
    [
        {"inputs": frozenset({"warp"})},
        {"inputs": frozenset({"lidar", "warp"})},
        {"inputs": frozenset({"radar"})},
        {"widths": (8, 0, 8)},
        {"num_sources": 0},
    ],
)
def test_impossible_networks_are_refused(settings):
    with pytest.raises(ConfigError):
        NanoConfig(**settings)


def test_config_survives_json():
    config = NanoConfig(inputs=frozenset({"render", "lidar"}), widths=(8, 16, 24))
    assert NanoConfig.from_dict(config.to_dict()) == config


def test_views_of_different_sizes_do_not_stack(make_conditions):
    with pytest.raises(ShapeError, match="one size"):
        stack_conditions([make_conditions(8, 8), make_conditions(8, 9)], num_sources=2)


def border_steps(confidence):
    """How much larger the steps between cells of 4 pixels are than those inside: across, down."""
    ratios = []
    for axis in (1, 0):
        steps = confidence.diff(dim=axis).abs().movedim(axis, 0)
        is_border = torch.arange(len(steps)) % CELL_PX == CELL_PX - 1
        ratios.append(float(steps[is_border].mean() / steps[~is_border].mean()))
    return ratios


def test_cells_leave_no_grid_in_the_confidence(make_conditions):
    conditions = make_conditions(96, 96)
    network = scrambled(NanoConfig(**SMALL))
    painter = NanoPainter(network, precision=torch.float32)
    raw = network(stack_conditions([conditions], num_sources=2), ["clear"]).log_error[0]
    assert min(border_steps(raw)) > 1.3  # what it is about
    log_error = (-painter.paint(conditions).confidence.log() * 0.05).log()
    assert max(border_steps(log_error)) < 1.1


def test_what_repeats_in_every_cell_becomes_its_mean():
    cell = torch.arange(16.0).view(4, 4)
    smooth = without_cells(cell.repeat(6, 6))
    assert torch.allclose(smooth[4:-4, 4:-4], torch.tensor(7.5))


def test_a_step_between_cells_becomes_an_even_slope():
    image = torch.zeros(16, 16)
    image[:, 8:] = 1.0
    row = without_cells(image)[8]
    assert torch.allclose(row[6:10], torch.tensor([0.125, 0.375, 0.625, 0.875]))
    assert row[5] == 0
    assert row[10] == 1
