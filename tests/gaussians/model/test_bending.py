"""People within their boxes: the lattice, its times, and what follows it."""

import pytest
import torch
from gaussian_world import round_gaussians

from lidarpainter_models.gaussians.model.bending import NODES, NUM_NODES, Bending

SIZE_M = torch.tensor([0.8, 0.6, 1.8])
KNOTS_NS = torch.tensor([0, 100, 250, 300, 500]) * 1_000_000
BODY = 2
TOP_LEFT_FRONT = NUM_NODES - 1


def lattice(knots_ns=KNOTS_NS):
    return Bending.none([BODY], [SIZE_M], knots_ns)


def figure(places, body=BODY):
    """Gaussians at places in a box, of which -0.5 and 0.5 are the ends."""
    means = torch.tensor(places) * SIZE_M
    return round_gaussians(means, torch.full((len(places), 3), 0.5), sigma_m=0.05, body=body)


def moved(bending, gaussians, timestamp_ns=0):
    return bending.bent(gaussians, timestamp_ns).means - gaussians.means


def test_a_lattice_at_rest_moves_nothing():
    assert not moved(lattice(), figure([[0.1, 0.2, -0.3]])).any()


def test_a_node_takes_along_what_is_at_it_and_half_of_what_is_halfway():
    bending = lattice()
    way_m = torch.tensor([0.1, -0.2, 0.05])
    bending.offset_m[0, 0, TOP_LEFT_FRONT] = way_m
    halfway = 0.5 - 0.5 / (NODES[2] - 1)
    places = [[0.5, 0.5, 0.5], [0.5, 0.5, halfway], [0.5, 0.0, 0.5], [-0.5, -0.5, -0.5]]
    shares = torch.tensor([1.0, 0.5, 0.0, 0.0])
    assert torch.allclose(moved(bending, figure(places)), shares[:, None] * way_m, atol=1e-7)


def test_beyond_its_box_a_figure_goes_with_the_nearest_face():
    bending = lattice()
    bending.offset_m[0, 0, TOP_LEFT_FRONT, 0] = 0.1
    assert float(moved(bending, figure([[0.6, 0.7, 0.8]]))[0, 0]) == pytest.approx(0.1)


def test_other_bodies_stay():
    bending = lattice()
    bending.offset_m[:] = 0.1
    others = figure([[0.0, 0.0, 0.0]], body=0).append(figure([[0.0, 0.0, 0.0]], body=3))
    assert bending.bent(others, 0) is others
    both = others.append(figure([[0.0, 0.0, 0.0]]))
    assert moved(bending, both)[:, 0].tolist() == pytest.approx([0, 0, 0.1])


@pytest.mark.parametrize("power", [0, 1])
def test_even_motion_is_kept_between_uneven_knots(power):
    bending = lattice()
    bending.offset_m[:] = ((KNOTS_NS / 1e9) ** power)[:, None, None, None]
    for timestamp_ns in (0, 40_000_000, 100_000_000, 170_000_000, 480_000_000, 500_000_000):
        expected = (timestamp_ns / 1e9) ** power
        assert bending.offset_at(timestamp_ns) == pytest.approx(expected, abs=1e-6)


def test_a_swing_is_met_between_knots_of_a_fifth_of_it():
    knots_ns = torch.arange(15) * 200_000_000
    bending = lattice(knots_ns)
    bending.offset_m[:] = torch.sin(2 * torch.pi * knots_ns / 1e9)[:, None, None, None]
    for timestamp_ns in (500_000_000, 1_100_000_000, 1_700_000_000):
        truth = torch.sin(torch.tensor(2 * torch.pi * timestamp_ns / 1e9))
        assert float(bending.offset_at(timestamp_ns).mean()) == pytest.approx(float(truth), abs=0.1)


def test_before_and_after_its_knots_a_figure_stands_still():
    bending = lattice()
    bending.offset_m[0], bending.offset_m[-1] = 0.1, 0.2
    assert bending.offset_at(-1_000).unique().tolist() == pytest.approx([0.1])
    assert bending.offset_at(10**10).unique().tolist() == pytest.approx([0.2])


def test_gradients_reach_centres_and_the_nodes_around_them_alone():
    bending, gaussians = lattice(), figure([[0.4, 0.3, 0.2]])
    bending.offset_m.requires_grad_(True)
    gaussians.means.requires_grad_(True)
    bending.bent(gaussians, 0).means.sum().backward()
    assert gaussians.means.grad.tolist() == [[1.0, 1.0, 1.0]]  # at rest its nodes are alike
    reached = bending.offset_m.grad.abs().sum(dim=-1)
    assert int((reached > 0).sum()) == 8
    assert float(bending.offset_m.grad.sum()) == pytest.approx(3.0)


def test_strain_counts_what_parts_neighbours():
    bending = lattice()
    bending.offset_m[:] = 0.1
    together = float(bending.strain(0))
    bending.offset_m[0, 0, : NUM_NODES // 2] = -0.1
    assert float(bending.strain(0)) > 5 * together > 0


def test_who_goes_leaves_the_lattices_of_the_others():
    both = Bending.none([2, 5], [SIZE_M, 2 * SIZE_M], KNOTS_NS)
    both.offset_m[:, 1] = 0.3
    rest = both.without(2)
    assert (rest.bodies.tolist(), rest.size_m.tolist()) == ([4], [(2 * SIZE_M).tolist()])
    assert rest.offset_m.shape[1] == 1
    assert float(rest.offset_m.min()) == pytest.approx(0.3)
    assert both.rigid(2).bodies.tolist() == [5]
    assert both.without(3).bodies.tolist() == [2, 4]
