"""Models and weights files: read exactly, and refused in one line where something is wrong."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_diffusion import write_model

from lidarpainter_models.errors import ConfigError, MissingPackageError, WeightsError
from lidarpainter_models.painter import selection
from lidarpainter_models.painter.baselines import UnpaintedPainter
from lidarpainter_models.painter.known_painters import WIRINGS
from lidarpainter_models.painter.one_step import loading
from lidarpainter_models.painter.one_step.assembly import trained_names
from lidarpainter_models.painter.one_step.config import PAPER, PRESETS
from lidarpainter_models.painter.one_step.loading import load_one_step, load_trainable
from lidarpainter_models.painter.one_step.weights import save_trained, stored_type
from lidarpainter_models.painter.precision import faster_type
from lidarpainter_models.painter.selection import load_painter
from lidarpainter_models.storage.tensor_files import HEADER_KEY, read_tensors

FLOAT = torch.float32
ROOT = Path(__file__).resolve().parents[3]
UNET = "unet/diffusion_pytorch_model.safetensors"


def as_trained(name):
    """A model or a weights file, ready to be trained on."""
    return load_trainable(str(name), PAPER, prompts=("clear",), dtype=torch.bfloat16)


@pytest.fixture
def own_model(model_folder, tmp_path):
    """A copy of the small model that a test may spoil."""
    return shutil.copytree(model_folder, tmp_path / "small-turbo")


@pytest.fixture(scope="module")
def training(model_folder, tmp_path_factory):
    """A weights file whose every weight was changed, and the network it was saved from."""
    made = as_trained(model_folder)
    generator = torch.Generator().manual_seed(0)
    state = dict(made.network.named_parameters())
    with torch.no_grad():
        for name in trained_names(made.network):
            state[name].add_(0.02 * torch.randn(state[name].shape, generator=generator))
            state[name].copy_(state[name].to(stored_type(name)))
    path = tmp_path_factory.mktemp("trained") / "trained.safetensors"
    provenance = {"steps": 3, "trained_targets": ["a"]}
    save_trained(made, path, licence="see the model", provenance=provenance)
    return made, path


@pytest.fixture
def trained(training, own_model, tmp_path):
    """A copy of the weights file beside a copy of its model, and the network."""
    made, original = training
    path = tmp_path / original.name
    shutil.copy(original, path)
    respell(path, lambda header, _: header.update(base=str(own_model)))
    return made, path


def test_weights_of_a_folder_arrive_unchanged(model_folder):
    network = load_one_step(f"{model_folder}:paper", dtype=FLOAT).network
    stored = load_file(model_folder / UNET)
    first = stored.pop("conv_in.weight")
    wide = network.denoiser.unet.conv_in.weight
    assert torch.equal(wide[:, :4], first)
    assert bool((wide[:, 4:] == 0).all())
    assert torch.equal(network.denoiser.unet.conv_out.layer.weight, stored.pop("conv_out.weight"))
    stored.pop("conv_out.bias")
    state = network.denoiser.unet.state_dict()
    assert all(torch.equal(state[name], tensor) for name, tensor in stored.items())
    stored = load_file(model_folder / "vae" / "diffusion_pytorch_model.safetensors")
    state = network.autoencoder.encoder.state_dict()
    assert all(torch.equal(state[name], stored[f"encoder.{name}"]) for name in state)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_paints_with_a_folders_weights(preset, model_folder, make_conditions):
    painter = load_painter(f"{model_folder}:{preset}")
    assert painter.provenance["licence"] == "unknown"
    painting = painter.paint(make_conditions(70, 100))
    assert painting.rgb.shape == (70, 100, 3)
    types = {parameter.dtype for parameter in painter.network.autoencoder.parameters()}
    assert types == {painter.precision} == {faster_type(torch.device("cpu"))}


def test_painter_goes_to_the_gpu_if_there_is_one(model_folder, monkeypatch):
    went = []

    def load(_name, *, device, dtype):
        went.append((device.type, dtype))
        return UnpaintedPainter()

    monkeypatch.setattr(loading, "load_one_step", load)
    monkeypatch.setattr(selection, "_loaded", {})
    load_painter(str(model_folder))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    load_painter(str(model_folder))
    assert went == [("cpu", None), ("cuda", None)]


def test_trained_weights_come_back_bit_for_bit(trained):
    made, path = trained
    again = as_trained(path)
    before, after = (dict(one.network.named_parameters()) for one in (made, again))
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert torch.equal(made.texts["clear"].bfloat16(), again.texts["clear"])
    assert again.provenance["trained_targets"] == ["a"]
    assert again.provenance["licence"] == "see the model"
    merged = load_painter(path)
    assert merged.network.config == made.network.config
    assert not any("lora" in name for name, _ in merged.network.named_parameters())


def test_a_model_that_moved_is_found_beside_its_weights(trained, tmp_path):
    _, path = trained
    there = tmp_path / "elsewhere"
    there.mkdir()
    shutil.move(path, there / path.name)
    shutil.move(tmp_path / "small-turbo", there / "small-turbo")
    assert load_painter(there / path.name).provenance["steps"] == 3


def respell(path, change):
    """Change a weights file's header and tensors."""
    tensors, header = read_tensors(path)
    change(header, tensors)
    save_file(tensors, path, {HEADER_KEY: json.dumps(header)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header, _: header.update(format="lidarpainter-one-step/9"), "expected 'lidarp"),
        (lambda header, _: header.pop("mark"), r"lacks \['mark'\]"),
        (lambda header, _: header.update(mark=[1.0, 2.0]), "trained on another model"),
        (lambda header, _: header.update(mark="abc"), "unusable settings"),
        (lambda header, _: header["config"].update(timestep=-5), "unusable settings"),
        (lambda header, _: header.update(provenance="x"), "unusable settings"),
        (lambda header, _: header["config"].update(autoencoder="jpeg"), "unusable settings"),
        (lambda _, tensors: tensors.update({"prompt:clear": torch.zeros(3, 4)}), "is encoded as"),
        (lambda header, _: header.update(base="/nowhere"), "needs its model: no painter '/now"),
        (lambda _, tensors: tensors.pop("fusion.layers.0.bias"), "'fusion.layers.0.bias' has sh"),
        (lambda _, tensors: tensors.update(more=torch.zeros(1)), r"'more' has shape \(1,\), exp"),
        (
            lambda _, tensors: tensors.update({"fusion.layers.0.bias": torch.zeros(3)}),
            r"has shape \(3,\), expected \(64,\)",
        ),
        (lambda _, tensors: tensors["fusion.layers.0.bias"].fill_(torch.inf), "no number"),
    ],
)
def test_wrong_weights_files_are_one_clear_line(trained, change, message):
    _, path = trained
    respell(path, change)
    with pytest.raises(WeightsError, match=message) as caught:
        load_one_step(str(path))
    assert "\n" not in str(caught.value)
    assert str(path.parent) in str(caught.value)


def narrower(folder):
    config = folder / "unet" / "config.json"
    values = json.loads(config.read_text())
    config.write_text(json.dumps(values | {"cross_attention_dim": 8}))


def nameless(folder):
    config = folder / "unet" / "config.json"
    values = json.loads(config.read_text())
    config.write_text(json.dumps(values | {"down_block_types": ["Mystery"] * 4}))


def without(name):
    def spoil(folder):
        tensors = load_file(folder / UNET)
        tensors.pop(name)
        save_file(tensors, folder / UNET)

    return spoil


def not_finite(folder):
    tensors = load_file(folder / UNET)
    tensors["conv_in.bias"].fill_(torch.nan)
    save_file(tensors, folder / UNET)


def pickled(folder):
    (folder / UNET).rename(folder / "unet" / "diffusion_pytorch_model.bin")


def wordless(folder):
    shutil.rmtree(folder / "text_encoder")


def half_a_text_encoder(folder):
    path = folder / "text_encoder" / "model.safetensors"
    tensors = load_file(path)
    tensors.pop(sorted(tensors)[0])
    save_file(tensors, path, {"format": "pt"})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: shutil.rmtree(folder / "unet"), "config.json: No such file"),
        (lambda folder: (folder / "vae/config.json").write_text("{"), "is no JSON"),
        (lambda folder: (folder / "vae/config.json").write_text("[]"), "holds a list"),
        (lambda folder: (folder / UNET).write_bytes(b"12345"), "not a readable safetensors"),
        (lambda folder: (folder / UNET).unlink(), "no weights in"),
        (pickled, "is a pickle, which is not read"),
        (without("mid_block.resnets.0.conv1.weight"), "conv1.weight' has shape None, expected"),
        (not_finite, "'conv_in.bias' holds values that are no number"),
        (narrower, r"expects \(77, 8\)"),
        (nameless, "make no network"),
        (half_a_text_encoder, "has missing keys"),
        (lambda folder: shutil.rmtree(folder / "tokenizer"), "text encoder of"),
    ],
)
def test_wrong_models_are_one_clear_line(own_model, spoil, message):
    spoil(own_model)
    with pytest.raises(WeightsError, match=message) as caught:
        load_one_step(str(own_model))
    assert "\n" not in str(caught.value)
    assert str(own_model) in str(caught.value)


def test_a_model_without_words_says_so(own_model):
    wordless(own_model)
    with pytest.raises(ConfigError, match="knows no prompt 'clear'"):
        load_one_step(str(own_model))


def test_a_model_nobody_has_is_not_fetched(monkeypatch, tmp_path):
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    for name in ("sd-turbo", "someone/model"):
        with pytest.raises(WeightsError, match="nothing is downloaded unasked") as caught:
            load_painter(name)
        assert "\n" not in str(caught.value)


LOADING = """
import sys
from pathlib import Path
import torch
from lidarpainter_models.painter import weight_reading
from tasks.measuring import measured

weight_reading.PORTION_NUMBERS = 1 << 22  # 16 MB of float32
with torch.device("meta"):
    layers = [torch.nn.Linear(2048, 2048, bias=False) for _ in range(24)]
    module = torch.nn.Sequential(*layers)
with measured() as nothing:
    pass
with measured() as loading:
    weight_reading.fill_from_file(module, Path(sys.argv[1]), dtype=torch.bfloat16)
assert all(bool((layer.weight == 1).all()) for layer in module)
print(loading.peak_memory_bytes - nothing.peak_memory_bytes)
"""


@pytest.mark.slow
def test_a_float32_file_never_lies_beside_its_bfloat16_weights(tmp_path):
    path = tmp_path / "large.safetensors"
    save_file({f"{index}.weight": torch.ones(2048, 2048) for index in range(24)}, path)
    command = [sys.executable, "-c", LOADING, str(path)]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    weights = 2 * 24 * 2048**2  # 201 MB; with a float32 copy of it all it would be three times that
    assert 0.9 * weights < int(answer.stdout) < 2.2 * weights


def test_a_missing_extra_names_itself(monkeypatch, model_folder):
    import lidarpainter_models.painter.one_step.architectures as packages

    def absent(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(packages, "import_module", absent)
    with pytest.raises(MissingPackageError, match=r"pip install 'lidarpainter\[diffusion\]'"):
        load_one_step(str(model_folder))


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"README.md": "---\nlicense: other\nlicense_name: sai-nc-community\n---\nx"}, "sai-nc"),
        ({"README.md": "---\nlicense: mit\n---\n"}, "mit"),
        ({"LICENSE.md": "\n# Community License\nmore"}, "Community License"),
        ({}, "unknown"),
    ],
)
def test_the_models_licence_is_told(own_model, files, expected):
    from lidarpainter_models.painter.one_step.base_models import open_base

    for name, text in files.items():
        (own_model / name).write_text(text)
    assert open_base(str(own_model)).licence.startswith(expected)


def test_a_known_models_licence_follows_from_its_configuration(own_model):
    from lidarpainter_models.painter.one_step.base_models import open_base

    path = own_model / "unet" / "config.json"
    values = json.loads(path.read_text()) | {"_name_or_path": "stabilityai/sd-turbo"}
    path.write_text(json.dumps(values))
    assert open_base(str(own_model)).licence.startswith("Stability AI")


def test_old_names_in_an_autoencoder_are_understood(own_model):
    path = own_model / "vae" / "diffusion_pytorch_model.safetensors"
    new = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    tensors = load_file(path)
    for name in list(tensors):
        for after, before in new.items():
            if f".{after}." in name:
                tensors[name.replace(f".{after}.", f".{before}.")] = tensors.pop(name)
    assert any(".query." in name for name in tensors)
    save_file(tensors, path)
    load_one_step(str(own_model))


def test_another_model_of_the_same_shape_is_found_out(trained, tmp_path):
    _, path = trained
    shutil.rmtree(tmp_path / "small-turbo")
    write_model(tmp_path / "small-turbo", seed=1)
    with pytest.raises(WeightsError, match="trained on another model"):
        load_one_step(str(path))


def test_every_preset_can_be_named_after_a_model():
    assert tuple(PRESETS) == WIRINGS
