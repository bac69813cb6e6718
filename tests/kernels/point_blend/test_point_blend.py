import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.point_blend import blend_points


@pytest.mark.parametrize("backend", ["reference", "cpu", "triton"])
def test_a_centred_point_fills_its_pixel_and_fades_with_distance(backend):
    rgb, total = blend_points(
        torch.tensor([[2.5, 1.5]]),
        torch.tensor([10.0]),
        torch.tensor([[0.2, 0.4]]),
        torch.full((3, 5), 10.0),
        weight=torch.tensor([3.0]),
        radius_px=torch.tensor([1.0]),
        backend=backend,
    )
    assert torch.allclose(rgb[1, 2], torch.tensor([0.2, 0.4]))
    assert total[1, 2] == 3.0
    assert total[1, 1] == pytest.approx(3.0 * 2.718281828**-2, rel=1e-5)
    assert total[0, 1] == 0  # a diagonal neighbour is farther than the radius
    assert (rgb[total == 0] == 0).all()


@pytest.mark.parametrize("backend", ["reference", "cpu", "triton"])
def test_points_of_another_surface_stay_out(backend):
    depths = torch.tensor([10.0, 20.0, 5.0])
    rgb, _ = blend_points(
        torch.full((3, 2), 1.5),
        depths,
        torch.tensor([[1.0], [0.0], [0.0]]),
        torch.full((3, 3), 10.1),
        weight=torch.ones(3),
        radius_px=torch.full((3,), 1.0),
        backend=backend,
    )
    assert rgb[1, 1, 0] == 1.0


def test_unequal_numbers_of_points_are_refused():
    four = torch.ones(4)
    with pytest.raises(ShapeError, match="weight"):
        blend_points(
            four.expand(2, 4).T,
            four,
            four[:, None],
            torch.ones(3, 3),
            weight=four[:3],
            radius_px=four,
        )
