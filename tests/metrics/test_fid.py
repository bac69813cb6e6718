"""FID and KID against their formulas, and the network whose features they compare."""

import hashlib

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.metrics import inception as module
from lidarpainter_models.metrics.fid import frechet_distance, kernel_distance
from lidarpainter_models.metrics.inception import Inception, load_inception

NUM_PARAMETERS = 21_785_568
"""Of the published network without its classifier: 23,834,568 less 1,000 classes of 2,049."""


def features(seed, count, size=6):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, size, generator=generator) * (1 + seed) + seed


def test_fid_is_the_distance_of_two_normal_distributions():
    one, two = features(0, 40), features(1, 50)
    first, second = (np.cov(each.numpy(), rowvar=False) for each in (one, two))
    between = np.square(one.mean(0).numpy() - two.mean(0).numpy()).sum()
    expected = between + np.trace(first + second - 2 * sqrtm(first @ second).real)
    assert frechet_distance(one, two) == pytest.approx(expected, rel=1e-5)


def test_fid_of_fewer_images_than_features_is_sound():
    one = features(0, 5, size=30)
    assert frechet_distance(one, one) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(one, one + 2) == pytest.approx(30 * 4, rel=1e-6)


def test_kid_is_the_unbiased_discrepancy():
    one, two = features(0, 7).double(), features(1, 5).double()

    def kernel(a, b):
        return float((a @ b / 6 + 1) ** 3)

    own = [
        sum(kernel(a, b) for i, a in enumerate(s) for j, b in enumerate(s) if i != j)
        / (len(s) * (len(s) - 1))
        for s in (one, two)
    ]
    across = sum(kernel(a, b) for a in one for b in two) / 35
    assert kernel_distance(one.float(), two.float()) == pytest.approx(sum(own) - 2 * across)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return Inception().eval().requires_grad_(requires_grad=False)


def test_the_network_has_the_published_size(network):
    assert sum(each.numel() for each in network.parameters()) == NUM_PARAMETERS
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert shapes["Mixed_5b.branch5x5_2.conv.weight"] == (64, 48, 5, 5)
    assert shapes["Mixed_6b.branch7x7dbl_5.conv.weight"] == (192, 128, 1, 7)
    assert shapes["Mixed_7b.branch3x3dbl_3b.conv.weight"] == (384, 384, 3, 1)
    assert shapes["Mixed_7c.branch_pool.bn.running_mean"] == (192,)


def test_grids_shrink_as_published(network):
    seen = {}
    for name, layer in network.named_children():
        layer.register_forward_hook(
            lambda _layer, _given, made, name=name: seen.__setitem__(name, tuple(made.shape[1:]))
        )
    found = network.features_of([torch.rand(20, 30, 3)] * 2)
    assert found.shape == (2, 2048)
    assert seen["Conv2d_4a_3x3"] == (192, 71, 71)
    assert seen["Mixed_5d"] == (288, 35, 35)
    assert seen["Mixed_6a"] == seen["Mixed_6e"] == (768, 17, 17)
    assert seen["Mixed_7a"] == (1280, 8, 8)
    assert seen["Mixed_7c"] == (2048, 8, 8)


def test_averages_leave_out_the_border_and_the_last_module_takes_the_largest(network):
    """As TensorFlow pools: a constant stays what it is up to the edge."""
    for name, inputs in (("Mixed_5b", 192), ("Mixed_6e", 768), ("Mixed_7b", 1280)):
        module_ = getattr(network, name)
        flat = module_._pooled(torch.ones(1, inputs, 5, 5))
        assert torch.allclose(flat, flat[..., 2:3, 2:3].expand_as(flat), atol=1e-5), name
    one = torch.zeros(1, 2048, 5, 5)
    one[..., 2, 2] = 1.0
    spread = network.Mixed_7c._pooled(one)[0].flatten(1)
    around = spread.reshape(-1, 5, 5)[:, 1:4, 1:4].flatten(1)
    assert torch.allclose(around, around[:, 4:5].expand_as(around), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("Mixed_5c", ["branch1x1", "branch5x5_2", "branch3x3dbl_3", "branch_pool"]),
        ("Mixed_6a", ["branch3x3", "branch3x3dbl_3"]),
        ("Mixed_6c", ["branch1x1", "branch7x7_3", "branch7x7dbl_5", "branch_pool"]),
        ("Mixed_7a", ["branch3x3_2", "branch7x7x3_4"]),
        (
            "Mixed_7b",
            [
                *("branch1x1", "branch3x3_2a", "branch3x3_2b"),
                *("branch3x3dbl_3a", "branch3x3dbl_3b", "branch_pool"),
            ],
        ),
    ],
)
def test_branches_are_joined_in_the_published_order(name, order):
    """The last layer of each branch says its number, whatever it is given."""
    layer = getattr(Inception().eval(), name)
    widths = []
    for number, branch in enumerate(order, start=1):
        last = layer.get_submodule(branch)
        last.register_forward_hook(lambda _l, _g, made, n=number: torch.full_like(made, n))
        widths.append(last.conv.out_channels)
    inputs = {"Mixed_5c": 256, "Mixed_6a": 288, "Mixed_7b": 1280}.get(name, 768)
    found = layer(torch.zeros(1, inputs, 9, 9))[0, : sum(widths), 0, 0]
    expected = [n for n, width in enumerate(widths, start=1) for _ in range(width)]
    assert found.tolist() == expected


def test_images_are_brought_to_bytes_of_the_networks_size():
    wide = torch.linspace(0, 1, 600)[None, :, None].expand(300, 600, 3)
    sized = module._as_bytes(wide)
    assert sized.shape == (1, 3, 299, 299)
    assert torch.equal(sized, sized.round())
    assert float((sized[0, 0, 0] - torch.linspace(0, 255, 299)).abs().max()) < 2


def test_only_the_published_file_is_taken(network, tmp_path, monkeypatch):
    path = tmp_path / "inception.pth"
    torch.save({**network.state_dict(), "fc.weight": torch.zeros(1008, 2048)}, path)
    with pytest.raises(WeightsError, match="not the published Inception of FID"):
        load_inception(path)
    monkeypatch.setattr(module, "PUBLISHED", hashlib.sha256(path.read_bytes()).hexdigest()[:8])
    image = torch.rand(16, 24, 3)
    same = load_inception(path).features_of([image])
    assert torch.equal(same, network.features_of([image]))


def test_another_network_is_refused_by_its_first_tensor(network, tmp_path, monkeypatch):
    path, name = tmp_path / "other.pth", "Mixed_5b.branch1x1.conv.weight"
    torch.save({**network.state_dict(), name: torch.zeros(1)}, path)
    monkeypatch.setattr(module, "PUBLISHED", "")
    with pytest.raises(WeightsError, match=rf"Inception of FID: tensor '{name}' has shape \(1,\)"):
        load_inception(path)
