"""Training of the one-step network, on a small one with random weights."""

from dataclasses import replace

import pytest
import torch
from quiet_augmentation import QUIET
from small_training import CONTEST
from tiny_diffusion import TEXT_WIDTH

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.adversarial import FrozenFeatures
from lidarpainter_models.painter.augmentation import batch_pairs
from lidarpainter_models.painter.losses import PaperLossWeights
from lidarpainter_models.painter.one_step.assembly import trained_names
from lidarpainter_models.painter.one_step.config import FAST, PAPER
from lidarpainter_models.painter.one_step.loading import load_trainable
from lidarpainter_models.painter.one_step.training import Judges, OneStepTrainee, train_one_step
from lidarpainter_models.painter.one_step.weights import save_trained
from lidarpainter_models.painter.selection import load_painter

SHORT = replace(CONTEST, loss=PaperLossWeights(lpips=0, adversarial=0), learning_rate=1e-2)
BRIEF = replace(SHORT, network=FAST)
"""Without the skips and the adapters of the large autoencoder."""
TEXTS = {"clear": torch.randn(77, TEXT_WIDTH, generator=torch.Generator().manual_seed(0))}


@pytest.fixture
def train(make_network):
    """Train a fresh small network; returns it and the record."""

    def run(config, sources, judges=None, **options):
        network = make_network(config.network, has_adapters=True)
        trainee = OneStepTrainee(network, TEXTS, config, judges)
        return network, train_one_step(trainee, sources, **options)

    return run


@pytest.fixture
def source(make_pair, memory_pairs):
    return memory_pairs([make_pair(64), make_pair(64, seed=1)])


def weights_of(network):
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()])


def test_training_lowers_the_loss_and_leaves_the_model_alone(
    train, make_network, make_pair, memory_pairs
):
    config = replace(SHORT, steps=7, learning_rate=3e-2)
    network, record = train(config, [memory_pairs([make_pair(64)])])
    totals = [entry["total"] for entry in record["history"]]
    assert sum(totals[-2:]) < 0.8 * sum(totals[:2])
    before = dict(make_network(config.network, has_adapters=True).named_parameters())
    names = set(trained_names(network))
    changed = {
        name for name, tensor in network.named_parameters() if not torch.equal(tensor, before[name])
    }
    assert changed == names


class Interruption(Exception):  # noqa: N818 - what a kill looks like from inside
    pass


def test_interrupted_training_resumes_bit_for_bit(train, source, tmp_path):
    config = replace(CONTEST, steps=3)
    straight, record = train(config, [source])
    assert record["discriminator"] == "PatchDiscriminator"

    def stop_at_one(progress):
        if progress.step == 1:
            raise Interruption

    with pytest.raises(Interruption):
        train(config, [source], checkpoint_folder=tmp_path, progress=stop_at_one)
    resumed, again = train(config, [source], checkpoint_folder=tmp_path)
    assert torch.equal(weights_of(straight), weights_of(resumed))
    for name in ("total", "discriminator", "gradient_penalty"):
        assert [entry[name] for entry in again["history"]] == [
            entry[name] for entry in record["history"]
        ]
    penalties = [entry["gradient_penalty"] for entry in record["history"]]
    assert [penalty > 0 for penalty in penalties] == [True, False, True]


def test_lpips_is_never_left_out_unasked(train, source):
    config = replace(BRIEF, steps=1, loss=PaperLossWeights(adversarial=0))
    with pytest.raises(ConfigError, match=r"weighs LPIPS by 0\.2 but has no weights for it"):
        train(config, [source])

    def distance(images, targets):
        return (images - targets).abs().mean(dim=(1, 2, 3))

    _, record = train(config, [source], Judges(lpips=distance))
    (entry,) = record["history"]
    expected = 0.2 * entry["lpips"] + 0.6 * entry["squared"] + 0.4 * entry["structure"]
    assert entry["lpips"] > 0
    assert entry["total"] == pytest.approx(expected)


def test_a_discriminator_looks_through_features_where_there_are_any(train, source):
    features = FrozenFeatures(extract=lambda images: [images], channels=(3,))
    config = replace(CONTEST, network=FAST, steps=1)
    _, record = train(config, [source], Judges(features=features))
    assert record["discriminator"] == "FeatureDiscriminator"


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"augmentation": replace(QUIET, crop_px=96)}, "multiples of 64"),
        ({"prompts": ("foggy",)}, "the first prompt must be"),
        ({"penalty_every_steps": 0}, "penalty_every_steps must be positive"),
        ({"accumulated_batches": 0}, "accumulated_batches must be positive"),
        ({"learning_rate": 1e38}, "learning_rate must be in"),
        ({"weight_decay": -0.1}, "weight_decay must be in"),
    ],
)
def test_impossible_settings_are_refused(settings, expected):
    with pytest.raises(ConfigError, match=expected):
        replace(SHORT, **settings)


def gradients(network, config, pair):
    trainee = OneStepTrainee(network, TEXTS, config)
    losses = trainee.learn(batch_pairs([pair], trainee.num_warps), step=0, share=1.0)
    return losses["total"], {name: one.grad for name, one in trainee.trained.items()}


def test_recomputed_activations_give_the_same_gradients(make_network, make_pair, monkeypatch):
    pair = make_pair(64)
    _, kept = gradients(make_network(PAPER, has_adapters=True), SHORT, pair)
    calls = []
    original = torch.utils.checkpoint.checkpoint

    def counted(*args, **options):
        calls.append(args)
        return original(*args, **options)

    monkeypatch.setattr("torch.utils.checkpoint.checkpoint", counted)
    config = replace(SHORT, recomputes=True)
    _, recomputed = gradients(make_network(PAPER, has_adapters=True), config, pair)
    assert len(calls) >= 7  # at least the blocks of the U-Net
    for name, gradient in kept.items():
        torch.testing.assert_close(recomputed[name], gradient)


def test_in_half_precision_what_is_trained_stays_in_float32(make_network, make_pair):
    network = make_network(PAPER, has_adapters=True)
    loss, _ = gradients(network, SHORT, make_pair(64))
    half = make_network(PAPER, has_adapters=True).to(torch.bfloat16)
    half.denoiser.unet.get_submodule("conv_out").float()
    rounded, found = gradients(half, replace(SHORT, half_precision=True), make_pair(64))
    names = set(trained_names(half))
    types = {name: tensor.dtype for name, tensor in half.named_parameters()}
    assert {types[name] for name in names} == {torch.float32}
    frozen = set(types) - names
    assert {types[name] for name in frozen if "conv_out" not in name} == {torch.bfloat16}
    assert all(one.dtype == torch.float32 and bool(one.isfinite().all()) for one in found.values())
    assert rounded == pytest.approx(loss, rel=0.05)  # eight bits, and a step that scales by 14.6


@pytest.mark.slow
def test_what_was_trained_is_saved_loaded_and_trained_on(model_folder, source, tmp_path):
    config = replace(SHORT, steps=2)
    made = load_trainable(
        str(model_folder), config.network, prompts=config.prompts, dtype=torch.float32
    )
    assert made.licence == "unknown"
    record = train_one_step(OneStepTrainee(made.network, made.texts, config), [source])
    path = tmp_path / "own.safetensors"
    provenance = {"steps": record["steps"], "trained_targets": []}
    save_trained(made, path, licence="own", provenance=provenance)
    painted = load_painter(path).paint(source.pairs[0].conditions).rgb
    untrained = load_painter(model_folder).paint(source.pairs[0].conditions).rgb
    assert not torch.equal(painted, untrained)
    again = load_trainable(str(path), config.network, prompts=("clear",), dtype=torch.float32)
    assert again.provenance["steps"] == 2
    state = dict(again.network.named_parameters())
    for name, tensor in made.network.named_parameters():
        torch.testing.assert_close(state[name], tensor, rtol=2**-8, atol=1e-6)  # adapters: bfloat16
    with pytest.raises(ConfigError, match="is wired otherwise"):
        load_trainable(str(path), FAST, prompts=("clear",), dtype=torch.float32)
