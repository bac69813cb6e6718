import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.point_blend import blend_points

EPS = torch.finfo(torch.float32).eps


def random_points(num_points, *, height_px=23, width_px=37, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def eighths(values):
        return (8 * values).round() / 8

    # places in eighths of a pixel and radii between them: no distance lies within rounding of a
    # radius, nor a depth of the tolerance
    size = torch.tensor([width_px + 6.0, height_px + 6.0])
    return {
        "positions_uv": eighths(uniform(num_points, 2) * size - 3),
        "depth_m": eighths(10 + uniform(num_points)),
        "attributes": uniform(num_points, 4),
        "surface_depth_m": 10.5 * (uniform(height_px, width_px) > 0.2),
        "weight": uniform(num_points),
        "radius_px": eighths(0.7 + 2.6 * uniform(num_points)) + 1 / 16,
    }


@pytest.mark.parametrize(
    ("num_points", "backend"),
    [*((count, "cpu") for count in (0, 1, 255, 2000)), *((n, "triton") for n in (0, 1, 400))],
)
def test_fast_blend_equals_the_plain_one(num_points, backend):
    inputs = random_points(num_points)
    expected, expected_total = blend_points(**inputs, backend="reference")
    actual, actual_total = blend_points(**inputs, backend=backend)
    # up to a hundred positive numbers summed in another order, exponentials to a few roundings
    most = 128 * EPS
    assert torch.allclose(actual, expected, rtol=most, atol=most)
    assert torch.allclose(actual_total, expected_total, rtol=most, atol=0)


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
    inputs = random_points(4)
    inputs["weight"] = torch.ones(3)
    with pytest.raises(ShapeError, match="weight"):
        blend_points(**inputs)
