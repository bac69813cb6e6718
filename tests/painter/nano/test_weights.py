"""Weights files and the errors they give."""

import json

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from lidarpainter_models.errors import WeightsError, WriteError
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.weights import load_weights, save_weights
from lidarpainter_models.painter.selection import load_painter

SMALL = NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1))


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    network = NanoNetwork(SMALL)
    torch.nn.init.normal_(network.head.weight, std=0.1)
    path = tmp_path / "weights" / "small.safetensors"
    save_weights(network, path, licence="Apache-2.0", provenance={"seed": 0})
    return network, path


def rewriting(change):
    """What changes the header and the tensors of a file."""

    def rewrite(path):
        with safe_open(path, "pt") as file:
            header = json.loads(file.metadata()["lidarpainter"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        change(header, tensors)
        save_file(tensors, path, {"lidarpainter": json.dumps(header)})

    return rewrite


def test_weights_survive_the_round_trip(saved, make_conditions):
    network, path = saved
    painter = load_painter(path)
    assert painter.name == "nano"
    assert painter.network.config == SMALL
    assert painter.provenance == {"seed": 0, "licence": "Apache-2.0"}
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(
            painter.network.state_dict()[name], tensor, rtol=1e-3, atol=1e-6
        )  # float16
    assert painter.paint(make_conditions()).rgb.shape == (24, 40, 3)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_full_size_weights_stay_small(tmp_path):
    path = tmp_path / "full.safetensors"
    save_weights(NanoNetwork(NanoConfig()), path, licence="Apache-2.0", provenance={})
    assert path.stat().st_size < 5.5e6


WIDER = NanoConfig(widths=(16, 8, 8), blocks=(1, 1, 1))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.unlink(), "is not there"),
        (
            lambda path: path.write_bytes(path.read_bytes()[:100]),
            "not a readable safetensors file",
        ),
        (
            rewriting(lambda header, _: header.update(format="other/3")),
            "has 'other/3', expected 'lidarpainter-nano/1'",
        ),
        (rewriting(lambda header, _: header.update(config={})), "unusable settings"),
        (rewriting(lambda header, _: header.update(config=WIDER.to_dict())), "expected"),
        (rewriting(lambda header, _: header.pop("licence")), "lacks"),
        (rewriting(lambda header, _: header.clear()), "has 'no format mark'"),
        (
            rewriting(lambda _, tensors: tensors.pop("head.bias")),
            "tensor 'head.bias' has shape None",
        ),
        (
            rewriting(lambda _, tensors: tensors["head.bias"].fill_(torch.nan)),
            "values that are no number",
        ),
    ],
)
def test_wrong_weights_files_are_one_clear_line(saved, spoil, message):
    _, path = saved
    spoil(path)
    with pytest.raises(WeightsError, match=message) as caught:
        load_weights(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_infinite_weights_are_not_saved(tmp_path):
    network = NanoNetwork(SMALL)
    torch.nn.init.constant_(network.stem.bias, torch.inf)
    with pytest.raises(WeightsError, match=r"stem\.bias"):
        save_weights(network, tmp_path / "w.safetensors", licence="x", provenance={})
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WriteError, match="cannot be written"):
        save_weights(
            NanoNetwork(SMALL), tmp_path / "file" / "w.safetensors", licence="x", provenance={}
        )
