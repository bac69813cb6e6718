import torch

from lidarpainter_models.lidar.ground_heights import GroundHeights

HOLE = torch.tensor([[10.5, 10.5]])


def sloping_road(*, without_hole=True):
    """Points every quarter metre of 20 m x 20 m, rising 5 cm per metre along x."""
    x, y = torch.meshgrid(torch.arange(0, 20, 0.25), torch.arange(0, 20, 0.25), indexing="ij")
    xyz = torch.stack([x.flatten(), y.flatten(), 0.05 * x.flatten()], dim=1)
    is_hole = (xyz[:, :2] - HOLE).abs().amax(dim=1) < 3
    return xyz[~is_hole] if without_hole else xyz


def test_heights_around_a_hole_close_it():
    found = float(GroundHeights(sloping_road()).around(HOLE))
    assert abs(found - 0.05 * 10.5) < 0.2


def test_what_stands_on_the_ground_does_not_lift_it():
    car = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    car = car * torch.tensor([2.0, 4.0, 0.5]) + torch.tensor([13.6, 8.0, 1.0])
    road = sloping_road()
    under_car = ((road[:, :2] - torch.tensor([14.6, 10.0])).abs() < torch.tensor([1.0, 2.0])).all(1)
    ground = GroundHeights(torch.cat([road[~under_car], car]))
    assert float(ground.around(torch.tensor([[13.0, 10.5]]))) < 0.05 * 13.0 + 0.25


def test_without_points_nothing_is_known_and_nothing_is_asked_of_no_place():
    assert bool(GroundHeights(torch.zeros(0, 3)).around(HOLE).isnan().all())
    assert GroundHeights(sloping_road()).around(HOLE[:0]).shape == (0,)
