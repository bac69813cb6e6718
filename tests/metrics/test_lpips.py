"""LPIPS: its three networks, its sum against plain loops, and the files it refuses."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.errors import ShapeError, WeightsError
from lidarpainter_models.metrics import lpips as lpips_module
from lidarpainter_models.metrics.backbones import (
    BACKBONES,
    SQUEEZENET,
    load_squeezenet_distance,
    load_stack,
)
from lidarpainter_models.metrics.lpips import HEAD_KEY, Lpips, load_lpips, read_heads
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.metrics.perceptual import load_distances

PARAMETERS = {"VGG-16": 14_714_688, "AlexNet": 2_469_696, "SqueezeNet 1.1": 722_496}
"""Of the features alone: what is left of the published counts without the classifiers."""


@pytest.fixture(params=BACKBONES, ids=lambda backbone: backbone.name)
def backbone(request):
    return request.param


def image_of(seed, side_px=72):
    return torch.rand(side_px, side_px + 8, 3, generator=torch.Generator().manual_seed(seed))


def random_heads(backbone, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(count, generator=generator) for count in backbone.channels]


def write_files(folder, backbone, heads=None):
    """Both halves with random weights, under the names that the published files use."""
    torch.manual_seed(0)
    stack = backbone.build()
    state = {f"features.{name}": value for name, value in stack.state_dict().items()}
    state["classifier.0.weight"] = torch.zeros(2, 2)
    torch.save(state, folder / "backbone.pth")
    heads = random_heads(backbone) if heads is None else heads
    named = {HEAD_KEY.format(i): head[None, :, None, None] for i, head in enumerate(heads)}
    torch.save(named, folder / "heads.pth")
    return LpipsFiles(backbone=folder / "backbone.pth", heads=folder / "heads.pth")


def trust_any_file(monkeypatch):
    """Random weights have no published digest."""
    monkeypatch.setattr(lpips_module, "is_published", lambda _path, _backbone: True)


def test_networks_have_the_published_parameters_and_channels(backbone):
    stack = backbone.build()
    assert sum(p.numel() for p in stack.parameters()) == PARAMETERS[backbone.name]
    seen = stack.compared_features(torch.rand(1, 3, 64, 64))
    assert tuple(features.shape[1] for features in seen) == backbone.channels
    assert Lpips(stack, random_heads(backbone)).channels == backbone.channels


def test_every_head_of_the_published_files_fits_its_network(shared_folder):
    found = {}
    for name in ("vgg", "alex", "squeeze"):
        backbone, heads = read_heads(shared_folder / f"weights/lpips/{name}.pth")
        found[name] = (backbone.name, tuple(len(head) for head in heads))
    assert found == {
        "vgg": ("VGG-16", (64, 128, 256, 512, 512)),
        "alex": ("AlexNet", (64, 192, 384, 256, 256)),
        "squeeze": ("SqueezeNet 1.1", (64, 128, 256, 384, 384, 512, 512)),
    }


def test_caffe_features_never_pass_for_the_backbone_of_lpips(shared_folder):
    weights = shared_folder / "weights"
    files = LpipsFiles(
        backbone=weights / "squeezenet_keras/squeezenet1_1_caffe_features.pth",
        heads=weights / "lpips/squeeze.pth",
    )
    with pytest.raises(WeightsError, match=r"is not the SqueezeNet 1\.1 that LPIPS was learnt on"):
        load_lpips(files)


def test_distance_is_the_weighted_sum_of_plain_loops(backbone, tmp_path, monkeypatch):
    trust_any_file(monkeypatch)
    distance = load_lpips(write_files(tmp_path, backbone))
    ours, truth = image_of(1), image_of(2)
    heads = random_heads(backbone)
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    expected = 0.0
    stack = load_stack(tmp_path / "backbone.pth", backbone)
    values = [(((2 * one - 1) - shift) / scale).permute(2, 0, 1)[None] for one in (ours, truth)]
    depth = 0
    for index, layer in enumerate(stack):
        values = [layer(value) for value in values]
        if index in stack.compared:
            one, other = (v[0] / (v[0].square().sum(0).sqrt() + 1e-10) for v in values)
            for channel, weight in enumerate(heads[depth].tolist()):
                expected += weight * float((one[channel] - other[channel]).square().mean())
            depth += 1
    assert float(distance(ours, truth)) == pytest.approx(expected, rel=1e-4)  # sums in float32


def test_equal_images_are_at_no_distance_and_others_pull(backbone, tmp_path, monkeypatch):
    trust_any_file(monkeypatch)
    distance = load_lpips(write_files(tmp_path, backbone))
    truth = image_of(0)
    assert float(distance(truth, truth)) == 0
    ours = (truth + 0.1 * (image_of(1) - 0.5)).requires_grad_(True)
    loss = distance(ours, truth)
    loss.backward()
    stepped = ours.detach() - 0.01 * ours.grad / ours.grad.norm()
    assert float(distance(stepped, truth)) < float(loss.detach())
    assert all(not parameter.requires_grad for parameter in distance.parameters())


def test_a_batch_holds_the_distances_of_its_images():
    backbone = BACKBONES[1]
    distance = Lpips(backbone.build(), random_heads(backbone))
    ours, truths = (torch.stack([image_of(s), image_of(s + 1)]) for s in (1, 5))
    together = distance.of_batch(ours.permute(0, 3, 1, 2), truths.permute(0, 3, 1, 2))
    alone = torch.stack([distance(a, b) for a, b in zip(ours, truths, strict=True)])
    torch.testing.assert_close(together, alone)


@pytest.mark.parametrize("size", [((63, 80, 3), (63, 80, 3)), ((80, 80, 3), (80, 72, 3))])
def test_images_it_cannot_compare_are_refused(size):
    distance = Lpips(SQUEEZENET.build(), random_heads(SQUEEZENET))
    with pytest.raises(ShapeError, match="two images of one size, at least 64 px"):
        distance.of_batch(*(torch.zeros(1, 3, *shape[:2]) for shape in size))


def test_half_of_the_weights_gives_no_figure_and_the_reason(tmp_path):
    assert load_lpips(LpipsFiles()) is None
    only_heads = load_distances(None, LpipsFiles(heads=tmp_path / "heads.pth"))
    assert only_heads.lpips is None
    assert only_heads.lpips_missing.endswith("a backbone not given")
    assert "linear heads" in LpipsFiles(backbone=tmp_path).missing


def damage(files, fault):
    if fault == "no backbone":
        files.backbone.unlink()
    elif fault == "garbage":
        files.heads.write_bytes(b"no weights")
    elif fault == "other network":
        write_files(files.heads.parent / "other", BACKBONES[1])
        files = replace(files, heads=files.heads.parent / "other" / "heads.pth")
    elif fault == "no heads":
        torch.save({"weight": torch.zeros(3)}, files.heads)
    elif fault == "not tensors":
        torch.save({"lin0.model.1.weight": "text"}, files.heads)
    return files


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("no backbone", "no SqueezeNet 1.1 weights at"),
        ("garbage", "is no readable weights file"),
        ("other network", "does not hold the features of AlexNet: tensor '0.weight' has shape"),
        ("no heads", "does not hold the LPIPS heads of"),
        ("not tensors", "expected a dict of tensors"),
        ("another training", "is not the SqueezeNet 1.1 that LPIPS was learnt on"),
    ],
)
def test_files_that_cannot_be_used_are_one_line(tmp_path, fault, expected):
    (tmp_path / "other").mkdir()
    files = damage(write_files(tmp_path, SQUEEZENET), fault)
    with pytest.raises(WeightsError, match=expected) as caught:
        load_lpips(files)
    assert "\n" not in str(caught.value)


def test_negative_heads_are_refused(tmp_path):
    heads = random_heads(SQUEEZENET)
    heads[3][5] = -0.1
    with pytest.raises(WeightsError, match="negative or not finite"):
        read_heads(write_files(tmp_path, SQUEEZENET, heads).heads)


def test_the_backbone_of_lpips_never_passes_for_the_caffe_features(tmp_path, monkeypatch):
    files = write_files(tmp_path, SQUEEZENET)
    monkeypatch.setattr(
        "lidarpainter_models.metrics.backbones.is_published", lambda _path, _backbone: True
    )
    with pytest.raises(WeightsError, match=r"is torchvision's SqueezeNet 1\.1"):
        load_squeezenet_distance(files.backbone)
