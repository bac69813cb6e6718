"""Pairs with styled targets: clear conditions, a prompt, and a target of the same window."""

from dataclasses import replace

import pytest
import torch
from quiet_augmentation import QUIET

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.augmentation import draw_batch, styled_pair, target_view
from lidarpainter_models.painter.examples import Window
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.training import (
    NanoTrainingConfig,
    train_nano,
    with_more_prompts,
)
from lidarpainter_models.painter.nano.weights import load_weights, save_weights

SMALL = NanoConfig(widths=(8, 16, 16), blocks=(1, 1, 1))
STYLED = replace(SMALL, prompts=("clear", "foggy", "night"))


def generator_of(seed):
    return torch.Generator().manual_seed(seed)


def deep_pair(make_pair, seed=0):
    """Depth falls from 60 m at the top to 3 m at the bottom; LiDAR and render know it."""
    pair = make_pair(48, seed)
    depth_m = torch.linspace(60, 3, 48)[:, None].expand(48, 48).contiguous()
    old = pair.conditions
    conditions = replace(
        old, render_depth_m=depth_m, lidar_depth_m=torch.where(old.lidar_hit, depth_m, 0.0)
    )
    return replace(pair, conditions=conditions)


def test_only_the_target_is_styled(make_pair):
    pair = deep_pair(make_pair)
    foggy = styled_pair(pair, "foggy", generator_of(0))
    assert foggy.conditions.prompt == "foggy"
    assert torch.equal(foggy.conditions.render_rgb, pair.conditions.render_rgb)
    assert torch.equal(foggy.target_valid, pair.target_valid)
    change = (foggy.target_rgb - pair.target_rgb).abs().mean(dim=(1, 2))
    assert float(change[:8].mean()) > 3 * float(change[-8:].mean())  # more, farther up
    assert styled_pair(pair, "clear", generator_of(0)).target_rgb is pair.target_rgb


def test_the_depth_of_the_target_is_lidar_where_it_hit(make_pair):
    pair = deep_pair(make_pair)
    old = pair.conditions
    wrong = replace(old, render_depth_m=old.render_depth_m + 5)
    view = target_view(replace(pair, conditions=wrong))
    assert torch.equal(view.depth_m[old.lidar_hit], old.lidar_depth_m[old.lidar_hit])
    assert torch.equal(view.depth_m[~old.lidar_hit], wrong.render_depth_m[~old.lidar_hit])


def test_what_is_open_below_a_lidar_hit_is_a_hole_and_no_sky(make_pair):
    pair = deep_pair(make_pair)
    hit = torch.zeros(48, 48, dtype=torch.bool)
    hit[20] = True
    conditions = replace(pair.conditions, lidar_hit=hit, render_alpha=torch.full((48, 48), 0.1))
    sky = target_view(replace(pair, conditions=conditions)).sky
    assert float(sky[:20].min()) == pytest.approx(0.9)
    assert float(sky[20:].max()) == 0


def draw(make_pair, memory_pairs, **settings):
    source = memory_pairs([deep_pair(make_pair, seed) for seed in range(3)])
    return draw_batch(
        [source],
        [1.0],
        batch_size=16,
        num_warps=2,
        config=replace(QUIET, **settings),
        generator=generator_of(5),
        prompts=STYLED.prompts,
    )


def test_a_share_of_the_samples_is_styled_and_their_conditions_stay_clear(make_pair, memory_pairs):
    batch = draw(make_pair, memory_pairs, style_share=0.5)
    assert set(batch.prompts) == {"clear", "foggy", "night"}
    assert 3 <= int(batch.restyled.sum()) <= 13
    warps, valid = batch.conditions.warp[:, 0], batch.conditions.warp_valid[:, :1]
    gaps = ((warps - batch.target).abs() * valid).amax(dim=(1, 2, 3))
    assert float(gaps[~batch.restyled].max()) < 1e-5  # warps show the clear truth
    assert float(gaps[batch.restyled].min()) > 0.1


def test_a_styled_window_is_cut_from_the_styled_image(make_pair, memory_pairs):
    """Airlight is that of the whole image, so cutting first would give another one."""
    pair = deep_pair(make_pair)
    window = Window(16, 8, 32, 32)
    whole = styled_pair(pair, "foggy", generator_of(0)).cropped(window)
    piece = styled_pair(pair.cropped(window), "foggy", generator_of(0))
    assert not torch.allclose(whole.target_rgb, piece.target_rgb, atol=1e-3)
    batch = draw(make_pair, memory_pairs, style_share=1.0)
    assert bool(batch.restyled.all())


def test_a_styled_target_never_passes_for_a_perfect_render(make_pair, memory_pairs):
    batch = draw(make_pair, memory_pairs, style_share=0.5, identity_share=1.0)
    same = (batch.conditions.render == batch.target).flatten(1).all(dim=1)
    assert torch.equal(same, ~batch.restyled)


def test_more_prompts_leave_what_is_known_as_it_was(make_conditions):
    torch.manual_seed(0)
    network = NanoNetwork(SMALL).eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    extended = with_more_prompts(network, STYLED).eval()
    conditions = make_conditions(32, 32)
    before, after = (
        NanoPainter(one, precision=torch.float32).paint(conditions) for one in (network, extended)
    )
    assert torch.equal(before.rgb, after.rgb)
    assert torch.equal(before.confidence, after.confidence)
    with pytest.raises(ConfigError, match="cannot start a network"):
        with_more_prompts(network, replace(STYLED, prompts=("foggy", "clear")))


def test_weights_with_styles_come_back(tmp_path):
    torch.manual_seed(0)
    path = tmp_path / "styled.safetensors"
    save_weights(NanoNetwork(STYLED), path, licence="MIT", provenance={})
    loaded = load_weights(path).network
    assert loaded.config == STYLED
    assert loaded.config.candidates[-1] == "tint"


@pytest.mark.parametrize(
    ("prompts", "expected"),
    [(("clear", "snow"), "no style 'snow'"), (("foggy", "clear"), "first prompt must be 'clear'")],
)
def test_prompts_that_cannot_be_trained_are_refused(prompts, expected):
    with pytest.raises(ConfigError, match=expected):
        NanoTrainingConfig(network=replace(SMALL, prompts=prompts))


def test_a_short_training_learns_that_a_prompt_for_night_means_night(make_pair, memory_pairs):
    source = memory_pairs([deep_pair(make_pair, seed) for seed in range(4)])
    config = NanoTrainingConfig(
        network=replace(SMALL, prompts=("clear", "night")),
        augmentation=replace(QUIET, style_share=0.5),
        steps=40,
        batch_size=4,
        learning_rate=1e-2,
        warm_up_steps=5,
        average_decay=0.8,
        half_precision=False,
    )
    painter = NanoPainter(train_nano([source], config)[0], precision=torch.float32)
    pair = deep_pair(make_pair, 1)
    dark = styled_pair(pair, "night", generator_of(0))
    for shown, own, other in ((pair, pair, dark), (dark, dark, pair)):
        painted = painter.paint(shown.conditions).rgb
        to_own, to_other = ((painted - one.target_rgb).abs().mean() for one in (own, other))
        assert float(to_own) < float(to_other)
