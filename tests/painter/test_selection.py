"""One reading of a painter's name: what it is, its digest, and that it is loaded once."""

import shutil

import pytest
import torch

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter.known_painters import BUNDLED_NANO
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.weights import save_weights
from lidarpainter_models.painter.selection import PainterChoice

CPU = torch.device("cpu")


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "own.safetensors"
    network = NanoNetwork(NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1)))
    save_weights(network, path, licence="MIT", provenance={})
    return path


def test_a_name_says_what_kind_of_painter_it_is(weights, model_folder):
    names = {"none": "rule", "warp": "rule", "nano": "nano", "sd-turbo": "one-step"}
    names |= {
        str(weights): "nano",
        str(model_folder): "one-step",
        f"{model_folder}:fast": "one-step",
    }
    assert {name: PainterChoice.of(name).kind for name in names} == names


def test_the_digest_is_that_of_the_bytes_wherever_they_lie(weights, tmp_path):
    copy = tmp_path / "copy.safetensors"
    shutil.copy(weights, copy)
    assert PainterChoice.of(weights).digest == PainterChoice.of(copy).digest
    assert PainterChoice.of(BUNDLED_NANO).digest == PainterChoice.of("nano").digest
    assert PainterChoice.of("warp").digest == "warp"
    before = PainterChoice.of(copy).digest
    copy.write_bytes(copy.read_bytes() + b"more")
    assert PainterChoice.of(copy).digest != before


def test_a_models_digest_follows_its_files_and_wiring(model_folder, tmp_path):
    folder = shutil.copytree(model_folder, tmp_path / "small-turbo")
    first = PainterChoice.of(folder).digest
    assert (
        first == PainterChoice.of(model_folder).digest == PainterChoice.of(f"{folder}:paper").digest
    )
    assert PainterChoice.of(f"{folder}:fast").digest != first
    path = folder / "tokenizer" / "merges.txt"
    path.write_text(path.read_text() + "a b\n")
    assert PainterChoice.of(folder).digest != first


def test_a_painter_is_loaded_once_and_again_when_its_file_changes(weights):
    first = PainterChoice.of(weights).load(CPU)
    assert PainterChoice.of(weights).load(CPU) is first
    network = NanoNetwork(NanoConfig(widths=(8, 8, 16), blocks=(1, 1, 1)))
    save_weights(network, weights, licence="MIT", provenance={})
    again = PainterChoice.of(weights).load(CPU)
    assert again.network.config.widths == (8, 8, 16)


@pytest.mark.parametrize("name", ["picasso", "missing.safetensors", "weights.pt"])
def test_a_painter_that_does_not_exist_is_named(tmp_path, name):
    with pytest.raises(WeightsError, match=f"no painter .*{name}"):
        _ = PainterChoice.of(tmp_path / name).digest
