"""Where a LiDAR tells too little of the street, images complete it; where it tells enough, not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaussian_world import bare_points
from toy_street import CAR_X_M, SKY, ToyStreet, car_y_m
from wall_drive import WALL_X_M, WallDrive

from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.lidar.map_building import gather_points
from lidarpainter_models.observations import preparation
from lidarpainter_models.observations.preparation import (
    CELL_RAD,
    LEAST_ON_ACTOR,
    LEAST_TOLD,
    completed,
    prepare_observations,
    share_told,
)
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.records import SweepPoints
from lidarpainter_models.scenes.splits import split_views

SIZE = ObservationConfig(width_px=160)
RING_Z_M = 0.3


class SweptWall(WallDrive):
    """The wall, swept along lines at some heights."""

    def __init__(self, *heights_m):
        super().__init__()
        self.sweeps, self._heights_m = ToyStreet().sweeps, torch.tensor(heights_m)

    def read_sweep(self, _sweep):
        x_m, y_m = torch.tensor([WALL_X_M]), torch.linspace(-8, 10, 400)
        return SweepPoints.of(torch.cartesian_prod(x_m, y_m, self._heights_m))


class LorryBeforeSky(SweptWall):
    """A tall lorry as pale as the sky, above a low wall; sweeps meet both."""

    def __init__(self):
        super().__init__(RING_Z_M)
        self.tracks = tuple(
            replace(track, size_m=torch.tensor([4.0, 1.8, 4.0])) for track in self.tracks
        )

    def read_image(self, view):
        image = super().read_image(view)
        sky = image[: int(view.camera.cy_px) - 10]
        noise = torch.Generator().manual_seed(view.frame_index)
        sky[:] = torch.tensor(SKY) + torch.randint(-3, 4, sky.shape, generator=noise)
        return image

    def read_sweep(self, sweep):
        wall = super().read_sweep(sweep).xyz_m
        return SweepPoints.of(torch.cat([wall, self.lorry_side(sweep.timestamp_ns)]))

    def lorry_side(self, timestamp_ns):
        """Returns from its side, 2 m above the ground: above the wall, as the camera sees it."""
        along_m = car_y_m(timestamp_ns * 1e-9) + torch.linspace(-0.5, 0.5, 10)
        x_m, z_m = torch.tensor([CAR_X_M - 0.9]), torch.tensor([2.0, 2.1, 2.2])
        return torch.cartesian_prod(x_m, along_m, z_m)


def points(xyz_m):
    return bare_points(torch.tensor(xyz_m), range_m=10.0)


def every_tenth(sweep):
    return SweepPoints(**{name: values[::10] for name, values in vars(sweep).items()})


@pytest.fixture(scope="module")
def prepared():
    street = SweptWall(RING_Z_M)
    return prepare_observations(street, split_views(street, "all"), SIZE)


def test_images_tell_the_wall_around_the_line_that_one_beam_drew(prepared):
    street = prepared.lidar_map.street
    assert prepared.is_estimated
    on_line = (street.xyz_m[:, 2] - RING_Z_M).abs() < 1e-4
    assert (
        int(on_line.sum()) >= 390
    )  # of 400, one sweep of a LiDAR that stands; all but those in the car's way
    beside = street.xyz_m[~on_line]
    assert len(beside) > 10_000
    assert float((beside[:, 0] - WALL_X_M).abs().median()) < 0.1


def test_what_images_tell_is_no_measured_depth(prepared):
    for view in prepared.views:
        row = (view.lidar_depth_m > 0).any(dim=1).nonzero()[:, 0]
        assert 1 <= len(row) <= 2  # where the beam's line is


def test_an_actor_that_a_beam_missed_has_its_box(prepared):
    (actor,) = prepared.lidar_map.actors.values()
    assert len(actor) > 100


def test_a_street_that_was_swept_well_is_left_to_the_lidar():
    street = SweptWall(*torch.arange(-5, 5, 0.1).tolist())
    views = split_views(street, "all")
    measured = gather_points(street, views.train_frames)
    assert share_told(measured.street, views.train, {}) > LEAST_TOLD
    prepared = prepare_observations(street, views, SIZE)
    assert not prepared.is_estimated
    assert torch.equal(prepared.lidar_map.street.xyz_m, measured.street.xyz_m)


def test_a_car_that_stands_has_the_little_that_was_measured():
    street = ToyStreet()
    street.read_sweep = lambda sweep: every_tenth(ToyStreet.read_sweep(street, sweep))
    views = split_views(street, "all")
    measured = gather_points(street, views.train_frames)
    assert share_told(measured.street, views.train, {}) < LEAST_TOLD
    prepared = prepare_observations(street, views, SIZE)
    assert not prepared.is_estimated
    assert torch.equal(prepared.lidar_map.street.xyz_m, measured.street.xyz_m)


@pytest.mark.slow
def test_a_lidar_that_met_nothing_leaves_the_street_to_the_images():
    street = WallDrive()
    views = split_views(street, "all")
    unswept = prepare_observations(street, views, SIZE)
    street.sweeps = ToyStreet().sweeps
    street.read_sweep = lambda _: SweepPoints.of(torch.zeros(0, 3))
    blocked = prepare_observations(street, views, SIZE)
    assert blocked.is_estimated
    assert torch.equal(blocked.lidar_map.street.xyz_m, unswept.lidar_map.street.xyz_m)
    assert set(blocked.lidar_map.actors) == set(unswept.lidar_map.actors)


def test_returns_from_an_actor_are_no_sky_where_images_complete_the_lidar():
    street = LorryBeforeSky()
    prepared = prepare_observations(street, split_views(street, "all"), SIZE)
    assert prepared.is_estimated
    for view in prepared.views:
        assert float(view.sky_mask.float().mean()) > 0.2
        pixels_uv, depth_m = view.camera.project(street.lorry_side(view.timestamp_ns))
        column, row = pixels_uv[view.camera.contains(pixels_uv, depth_m)].long().unbind(-1)
        assert len(row) == 30
        assert not bool(view.sky_mask[row, column].any())


def test_of_many_images_every_camera_is_asked():
    cameras = [f"camera {place}" for place in range(6)]
    street = ToyStreet(40, tuple((name, 1.0) for name in cameras))  # all look the same way
    line = gather_points(SweptWall(RING_Z_M), [0]).street
    told = share_told(line, street.views, {})
    assert 0 < told < 1
    hides_all = np.ones((10, 10), bool)
    for own in cameras:
        others = {name: hides_all for name in cameras if name != own}
        assert share_told(line, street.views, others) == told


def test_of_many_points_no_more_are_looked_at_than_allowed(monkeypatch):
    views = SweptWall(RING_Z_M).views
    line = gather_points(SweptWall(RING_Z_M), [0]).street
    behind = replace(line, xyz_m=-line.xyz_m)
    by_turns = torch.arange(2 * len(line)).view(2, -1).T.flatten()
    street = MapPoints.concatenate([behind, line]).keep(by_turns)
    assert share_told(street, views, {}) > 0
    monkeypatch.setattr(preparation, "_MOST_POINTS", len(street) - 1)
    assert share_told(street, views, {}) == 0  # of each two the first, which is behind


def test_cells_of_the_recording_car_are_not_asked():
    street = SweptWall(RING_Z_M)
    views = split_views(street, "all")
    line = gather_points(street, views.train_frames).street
    alone = share_told(line, views.train, {})
    body = np.zeros((10, 10), bool)
    body[6:] = True  # all that looks down but the uppermost rows
    assert alone < share_told(line, views.train, {"front": body})
    assert share_told(line, views.train, {"front": np.ones((10, 10), bool)}) == 1.0


def test_estimates_beside_a_measured_point_are_dropped_and_all_else_is_kept():
    within = 0.5 * CELL_RAD * 10.0
    measured = LidarMap(street=points([[10.0, 0.0, 0.0]]), actors={"few": points([[0.0, 0, 0]])})
    estimated = LidarMap(
        street=points([[10.0, within, 0.0], [10.0, 4 * within, 0.0]]),
        actors={"few": points([[1.0, 0, 0]]), "unseen": points([[1.0, 0, 0]])},
    )
    both = completed(measured, estimated)
    assert both.street.xyz_m[:, 1].tolist() == pytest.approx([0.0, 4 * within])
    assert both.actors["few"].xyz_m[0, 0] == 1.0  # a single return tells no shape
    assert set(both.actors) == {"few", "unseen"}


@pytest.mark.parametrize(
    ("num_returns", "is_told"), [(LEAST_ON_ACTOR - 1, False), (LEAST_ON_ACTOR, True)]
)
def test_an_actor_keeps_its_returns_from_the_least_number_on(num_returns, is_told):
    returns, on_box = points(torch.zeros(num_returns, 3).tolist()), points([[1.0, 0, 0]])
    measured = LidarMap(street=points([[10.0, 0, 0]]), actors={"car": returns})
    estimated = LidarMap(street=points([[10.0, 5, 0]]), actors={"car": on_box})
    assert completed(measured, estimated).actors["car"] is (returns if is_told else on_box)


def test_returns_from_an_actor_are_kept_where_the_street_gave_none():
    returns = points(torch.zeros(LEAST_ON_ACTOR, 3).tolist())
    measured = LidarMap(street=MapPoints.concatenate([]), actors={"car": returns})
    estimated = LidarMap(street=points([[10.0, 5, 0]]), actors={"car": points([[1.0, 0, 0]])})
    both = completed(measured, estimated)
    assert torch.equal(both.street.xyz_m, estimated.street.xyz_m)
    assert both.actors["car"] is returns
