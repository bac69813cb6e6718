"""The feature distance is zero for equal images and refuses foreign weights."""

import pytest
import torch

from lidarpainter_models.errors import WeightsError
from lidarpainter_models.metrics.backbones import (
    SqueezeNetDistance,
    load_squeezenet_distance,
    squeezenet_stack,
)


def test_distance_grows_with_blur(shared_folder):
    path = shared_folder / "weights/squeezenet_keras/squeezenet1_1_caffe_features.pth"
    distance = load_squeezenet_distance(path)
    image = torch.rand(96, 128, 3, generator=torch.Generator().manual_seed(0))
    pooled = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], 3, 1, 1)
    blurred = pooled[0].permute(1, 2, 0)
    assert float(distance(image, image)) == 0
    assert float(distance(blurred, image)) > float(distance(0.9 * image, image)) > 0


@pytest.mark.parametrize("fault", ["missing", "foreign"])
def test_wrong_weights_are_refused_in_one_line(tmp_path, fault):
    path = tmp_path / "weights.pth"
    if fault == "foreign":
        torch.save({"conv.weight": torch.zeros(3)}, path)
    with pytest.raises(WeightsError) as caught:
        load_squeezenet_distance(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_own_weights_round_trip(tmp_path):
    network = SqueezeNetDistance(squeezenet_stack())
    path = tmp_path / "weights.pth"
    state = {key.removeprefix("layers."): value for key, value in network.state_dict().items()}
    torch.save(state, path)
    image = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(3))
    loaded = load_squeezenet_distance(path)
    assert torch.equal(loaded(image, image * 0.5), network(image, image * 0.5))
