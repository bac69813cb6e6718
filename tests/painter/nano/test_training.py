"""Training, its checkpoints and the batches it draws."""

from dataclasses import replace

import pytest
import torch
from quiet_augmentation import QUIET
from strict_device import NAME, strict_runs

from lidarpainter_models.errors import ConfigError, DataError, TrainingError
from lidarpainter_models.painter.augmentation import (
    AugmentationConfig,
    augment,
    batch_pairs,
    draw_batch,
)
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.training import NanoTrainingConfig, train_nano
from lidarpainter_models.painter.render_damage import damage_render

NETWORK = NanoConfig(widths=(16, 16, 16), blocks=(1, 1, 1))
SHORT = NanoTrainingConfig(
    network=NETWORK,
    augmentation=AugmentationConfig(crop_px=32),
    steps=6,
    batch_size=2,
    warm_up_steps=2,
    log_every_steps=2,
)


def weights_of(network):
    return torch.cat([parameter.flatten() for parameter in network.parameters()])


def test_overfitting_one_pair_lowers_the_loss(make_pair, memory_pairs):
    pair = make_pair(32)
    config = replace(SHORT, augmentation=QUIET, steps=60, warm_up_steps=10, average_decay=0.9)
    network, record = train_nano([memory_pairs([pair])], config)
    history = record["history"]
    assert history[-1]["absolute"] < 0.6 * history[0]["absolute"]
    painted = NanoPainter(network).paint(pair.conditions).rgb
    before = (pair.conditions.render_rgb - pair.target_rgb).abs().mean()
    assert float((painted - pair.target_rgb).abs().mean()) < 0.5 * float(before)


class Interruption(Exception):  # noqa: N818 - what a kill looks like from inside
    pass


def test_interrupted_training_resumes_bit_for_bit(make_pair, memory_pairs, tmp_path):
    source = memory_pairs([make_pair(48, seed) for seed in (0, 1)])
    straight, expected = train_nano([source], SHORT)

    def stop_at_four(progress):
        if progress.step == 4:
            raise Interruption

    config = replace(SHORT, checkpoint_every_s=0.0)
    with pytest.raises(Interruption):
        train_nano([source], config, checkpoint_folder=tmp_path, progress=stop_at_four)
    resumed, record = train_nano([source], config, checkpoint_folder=tmp_path)
    assert torch.equal(weights_of(straight), weights_of(resumed))
    assert [entry["step"] for entry in record["history"]] == [2, 4, 6]
    for name in ("absolute", "total"):
        assert [entry[name] for entry in record["history"]] == [
            entry[name] for entry in expected["history"]
        ]


def test_a_seed_decides_the_weights(make_pair, memory_pairs):
    source = memory_pairs([make_pair(48)])
    config = replace(SHORT, steps=2)
    first, again = (train_nano([source], config)[0] for _ in range(2))
    other, _ = train_nano([source], replace(config, seed=1))
    assert torch.equal(weights_of(first), weights_of(again))
    assert not torch.equal(weights_of(first), weights_of(other))


def test_training_leaves_the_global_generator_alone(make_pair, memory_pairs):
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    train_nano([memory_pairs([make_pair(32)])], replace(SHORT, steps=1))
    assert torch.equal(torch.rand(4), expected)


def test_a_cpu_budget_ends_the_training(make_pair, memory_pairs):
    config = replace(SHORT, steps=10**6, max_cpu_s=0.3)
    _, record = train_nano([memory_pairs([make_pair(32)])], config)
    assert record["cpu_s"] >= 0.3
    assert record["steps"] < 10**4


def test_no_pairs_are_one_clear_line(memory_pairs):
    with pytest.raises(DataError, match="no training pairs"):
        train_nano([memory_pairs([])], SHORT)


def test_a_loss_that_is_no_number_stops_and_keeps_the_checkpoint(make_pair, memory_pairs, tmp_path):
    good = make_pair(32)
    source = memory_pairs([good])
    config = replace(SHORT, augmentation=QUIET, checkpoint_every_s=0.0)

    def spoil(progress):
        if progress.step == 2:
            source.pairs[0] = replace(good, target_rgb=torch.full_like(good.target_rgb, torch.nan))

    with pytest.raises(TrainingError, match="at step 2") as caught:
        train_nano([source], config, checkpoint_folder=tmp_path, progress=spoil)
    assert "\n" not in str(caught.value)
    source.pairs[0] = good
    resumed, _ = train_nano([source], config, checkpoint_folder=tmp_path)
    assert torch.equal(weights_of(resumed), weights_of(train_nano([source], config)[0]))


def test_a_network_that_says_the_same_everywhere_is_noticed(make_pair, memory_pairs, monkeypatch):
    monkeypatch.setattr("lidarpainter_models.painter.nano.training.ALIVE_AFTER_STEPS", 0)
    # at this rate nothing moves, and the first network knows no difference between pixels
    config = replace(SHORT, learning_rate=1e-12)
    with pytest.raises(TrainingError, match="same in every pixel at step 2") as caught:
        train_nano([memory_pairs([make_pair(32)])], config)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_another_training_is_refused(make_pair, memory_pairs, tmp_path):
    pairs = [make_pair(32)]
    config = replace(SHORT, steps=1)
    train_nano([memory_pairs(pairs)], config, checkpoint_folder=tmp_path)
    with pytest.raises(ConfigError, match="other settings or pairs"):
        train_nano([memory_pairs(pairs, "others")], config, checkpoint_folder=tmp_path)


def unreadable(path):
    path.write_bytes(b"not a checkpoint")


def misshapen(path):
    saved = torch.load(path, weights_only=True)
    saved["averaged"]["head.bias"] = torch.zeros(3)
    torch.save(saved, path)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (unreadable, "not a readable training checkpoint"),
        (misshapen, r"'head.bias' has shape \(3,\)"),
    ],
)
def test_a_damaged_checkpoint_is_one_clear_line(spoil, message, make_pair, memory_pairs, tmp_path):
    source, config = memory_pairs([make_pair(32)]), replace(SHORT, steps=1)
    train_nano([source], config, checkpoint_folder=tmp_path)
    spoil(tmp_path / "training.pt")
    with pytest.raises(DataError, match=message) as caught:
        train_nano([source], config, checkpoint_folder=tmp_path)
    assert "\n" not in str(caught.value)


def test_a_training_may_go_on_from_weights(make_pair, memory_pairs):
    source = memory_pairs([make_pair(32, seed) for seed in range(4)])
    network, first = train_nano([source], SHORT)
    slow = replace(SHORT, learning_rate=1e-12)
    still, then = train_nano([source], slow, start=network)
    for name, tensor in still.state_dict().items():
        torch.testing.assert_close(tensor, network.state_dict()[name])
    _, from_nothing = train_nano([source], slow)
    digests = {one["training_digest"] for one in (first, then, from_nothing)}
    assert len(digests) == 3


def test_weights_of_another_network_are_no_start(make_pair, memory_pairs):
    source = memory_pairs([make_pair(32)])
    other = NanoNetwork(replace(SHORT.network, residual_limit=0.5))
    with pytest.raises(ConfigError, match="cannot start a network"):
        train_nano([source], SHORT, start=other)


def test_shares_must_fit_the_sources(make_pair, memory_pairs):
    source = memory_pairs([make_pair(32)])
    with pytest.raises(ConfigError, match="source_shares"):
        train_nano([source], replace(SHORT, source_shares=(0.5, 0.5)))
    with pytest.raises(ConfigError, match="source_shares"):
        train_nano([source, memory_pairs([])], replace(SHORT, source_shares=(0.5, 0.5)))


def test_shares_choose_the_source(make_pair, memory_pairs):
    dark, light = make_pair(32, 0), make_pair(32, 0)
    dark = replace(dark, target_rgb=torch.zeros_like(dark.target_rgb))
    batch = draw_batch(
        [memory_pairs([dark]), memory_pairs([light])],
        [1.0, 0.0],
        batch_size=4,
        num_warps=2,
        config=QUIET,
        generator=torch.Generator().manual_seed(0),
    )
    assert float(batch.target.max()) == 0


def test_images_smaller_than_the_window_are_refused(make_pair, memory_pairs):
    with pytest.raises(ConfigError, match="smaller than crop_px"):
        train_nano([memory_pairs([make_pair(24)])], SHORT)


@pytest.mark.parametrize(
    "settings", [{"crop_px": 40}, {"damage_share": 1.5}, {"identity_share": -0.1}]
)
def test_impossible_augmentation_is_refused(settings):
    with pytest.raises(ConfigError):
        AugmentationConfig(**settings)


def generator_of(seed):
    return torch.Generator().manual_seed(seed)


def test_quiet_augmentation_only_flips(make_pair):
    batch = batch_pairs([make_pair(32, seed) for seed in range(6)], 2)
    flipped = augment(batch, QUIET, generator_of(0))
    for index in range(6):
        is_same = torch.equal(flipped.target[index], batch.target[index])
        before = batch.conditions.warp[index]
        expected = before if is_same else before.flip(-1)
        torch.testing.assert_close(flipped.conditions.warp[index], expected)


def test_light_changes_every_image_of_a_sample_alike(make_pair):
    batch = batch_pairs([make_pair(32)], 2)
    bright = replace(QUIET, gain_range=0.5)
    changed = augment(batch, bright, generator_of(1))
    gain = changed.target.mean() / batch.target.mean()
    assert abs(float(gain) - 1) > 0.02
    hits = changed.conditions.lidar_hit > 0
    apart = (changed.conditions.lidar - changed.target).abs().mean(dim=1, keepdim=True)
    assert float(apart[hits].max()) < 1e-5


def test_dropout_takes_images_and_masks_away_together(make_pair):
    batch = batch_pairs([make_pair(32)], 2)
    bare = replace(QUIET, lidar_dropout_share=1, warp_dropout_share=1)
    conditions = augment(batch, bare, generator_of(0)).conditions
    for name in ("lidar", "lidar_hit", "lidar_depth_m", "warp", "warp_valid"):
        assert float(getattr(conditions, name).abs().max()) == 0


def test_losing_the_best_warp_moves_the_second_up(make_pair):
    batch = batch_pairs([make_pair(32)], 2)
    swapped = augment(batch, replace(QUIET, warp_swap_share=1), generator_of(0)).conditions
    counts = batch.conditions.warp_valid.sum(dim=(2, 3))
    assert swapped.warp_valid[:, 0].sum() == counts[:, 1]
    assert float(swapped.warp_valid[:, 1].max()) == 0


def test_identity_samples_show_the_truth(make_pair):
    batch = batch_pairs([make_pair(32)], 2)
    shown = augment(batch, replace(QUIET, identity_share=1), generator_of(0))
    assert torch.equal(shown.conditions.render, shown.target)


def test_damage_stays_in_range_and_leaves_most_of_the_image():
    render = torch.rand(3, 48, 64, generator=generator_of(0))
    for seed in range(20):
        damaged = damage_render(render, generator_of(seed))
        assert damaged.shape == render.shape
        assert bool(((damaged >= 0) & (damaged <= 1)).all())
        assert not torch.equal(damaged, render)


@pytest.mark.slow
def test_a_device_learns_what_the_cpu_learns(make_pair, memory_pairs, monkeypatch):
    source = memory_pairs([make_pair(48, seed) for seed in (0, 1)])
    config = replace(SHORT, half_precision=False, steps=3, log_every_steps=1)
    _, here = train_nano([source], config)
    with strict_runs(monkeypatch) as device:
        _, there = train_nano([source], config, device=device)
    assert (here["device"], there["device"]) == ("cpu", NAME)
    losses, expected = ([entry["total"] for entry in one["history"]] for one in (there, here))
    # Adam makes steps of full length of gradients that are roundings alone
    assert losses == pytest.approx(expected, rel=1e-3)
