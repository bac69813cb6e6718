import numba
import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.point_splat import splat_points
from lidarpainter_models.kernels.point_splat.cpu import LEAST_RUN


def random_splat(num_points, seed, *, height_px=37, width_px=53, max_radius_px=3):
    """Points in and around the image, many at equal depth, some behind or not finite."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.randint(-6, width_px + 6, (num_points,), generator=generator)
    v = torch.randint(-6, height_px + 6, (num_points,), generator=generator)
    depth_m = torch.randint(-1, 20, (num_points,), generator=generator) / 2.0
    depth_m[::17] = torch.inf
    depth_m[5::29] = torch.nan
    return {
        "pixels_uv": torch.stack([u, v], dim=-1),
        "depth_m": depth_m,
        "radius_px": torch.randint(0, max_radius_px + 1, (num_points,), generator=generator),
        "height_px": height_px,
        "width_px": width_px,
    }


def test_points_of_different_pieces_compete_for_a_pixel():
    count = LEAST_RUN + 1000
    inputs = random_splat(count, seed=1, max_radius_px=0)
    inputs["depth_m"] = torch.rand(count, generator=torch.Generator().manual_seed(2))
    inputs["depth_m"][::2] = 0.5  # ties across pieces go to the lower index
    inputs["depth_m"][LEAST_RUN:] *= 1e-4
    inputs["depth_m"][LEAST_RUN - 7] = 1e-9
    expected = splat_points(**inputs, backend="reference")
    actual = splat_points(**inputs, backend="cpu")
    assert torch.equal(actual, expected)
    assert set((actual.unique() >= LEAST_RUN).tolist()) == {False, True}


@pytest.mark.parametrize("backend", ["reference", "cpu", "triton"])
@pytest.mark.parametrize(("radius_px", "covered"), [(0, 1), (1, 9), (2, 21), (3, 37)])
def test_a_disc_covers_its_pixels(radius_px, covered, backend):
    image = splat_points(
        torch.tensor([[5, 4]]),
        torch.tensor([2.0]),
        height_px=10,
        width_px=11,
        radius_px=radius_px,
        backend=backend,
    )
    assert int((image == 0).sum()) == covered
    assert image[4, 5] == 0
    assert image[4, 5 + radius_px] == 0


@pytest.mark.parametrize("backend", ["reference", "cpu", "triton"])
def test_the_nearest_point_wins_and_ties_go_to_the_lower_index(backend):
    pixels = torch.tensor([[1, 1], [1, 1], [1, 1], [0, 0], [0, 0]])
    depth_m = torch.tensor([3.0, 2.0, 2.0, 7.0, -1.0])
    image = splat_points(pixels, depth_m, height_px=2, width_px=2, backend=backend)
    assert image.tolist() == [[3, -1], [-1, 1]]


@pytest.mark.parametrize("backend", ["reference", "cpu", "triton"])
def test_a_near_point_grows_over_its_neighbours(backend):
    pixels, depth_m = torch.tensor([[2, 2], [3, 2], [5, 2]]), torch.tensor([1.0, 5.0, 5.0])
    radius_px = torch.tensor([1, 0, 0])
    image = splat_points(
        pixels, depth_m, height_px=5, width_px=6, radius_px=radius_px, backend=backend
    )
    assert image[2].tolist() == [-1, 0, 0, 0, -1, 2]


@pytest.mark.parametrize("backend", ["reference", "cpu", "triton"])
def test_a_point_outside_still_reaches_into_the_image(backend):
    image = splat_points(
        torch.tensor([[-1, 1]]),
        torch.tensor([1.0]),
        height_px=3,
        width_px=3,
        radius_px=1,
        backend=backend,
    )
    assert image.tolist() == [[0, -1, -1]] * 3


def test_the_number_of_threads_changes_nothing():
    inputs = random_splat(5000, seed=4)
    threads = numba.get_num_threads()
    try:
        images = []
        for num_threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(num_threads)
            images.append(splat_points(**inputs, backend="cpu"))
    finally:
        numba.set_num_threads(threads)
    assert torch.equal(*images)


def test_points_that_do_not_fit_together_are_refused():
    with pytest.raises(ShapeError, match="one depth per point"):
        splat_points(torch.zeros(3, 2, dtype=torch.int64), torch.ones(2), height_px=2, width_px=2)
    with pytest.raises(ShapeError, match="one radius per point"):
        splat_points(
            torch.zeros(2, 2, dtype=torch.int64),
            torch.ones(2),
            height_px=2,
            width_px=2,
            radius_px=torch.zeros(3, dtype=torch.int64),
        )
    with pytest.raises(ShapeError, match=">= 0"):
        splat_points(
            torch.zeros(1, 2, dtype=torch.int64),
            torch.ones(1),
            height_px=2,
            width_px=2,
            radius_px=-1,
        )


@pytest.mark.parametrize("most_px", [0, 1, 3])
def test_points_many_times_as_many_as_pixels_keep_the_same_ones(most_px):
    """Where discs are drawn of the nearest points alone; depths are rounded, so that many tie."""
    random = torch.Generator().manual_seed(most_px)
    pixels_uv = torch.rand(20_000, 2, generator=random) * torch.tensor([40.0, 30]) - 4
    depth_m = (torch.rand(20_000, generator=random) * 200).round() / 10 - 1
    radius_px = torch.randint(0, most_px + 1, (20_000,), generator=random)
    size = {"height_px": 22, "width_px": 32, "radius_px": radius_px}
    expected = splat_points(pixels_uv, depth_m, **size, backend="reference")
    assert torch.equal(splat_points(pixels_uv, depth_m, **size), expected)
