"""A log without LiDAR gets its points from training images."""

import pytest
import torch
from toy_street import CAR_SIZE_M, ToyStreet
from wall_drive import WALL_X_M, WallDrive

from lidarpainter_models.errors import SceneError
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.splits import split_views


@pytest.fixture(scope="module")
def prepared():
    street = WallDrive()
    return prepare_observations(street, split_views(street, "all"), ObservationConfig(width_px=160))


def test_points_lie_on_what_stands_still(prepared):
    street = prepared.lidar_map.street
    assert len(street) > 10_000
    off_m = (street.xyz_m[:, 0] - WALL_X_M).abs()
    assert float(off_m.median()) < 0.1
    assert float((off_m < 0.05 * WALL_X_M).float().mean()) > 0.93
    assert float(street.has_colour.float().mean()) > 0.9
    assert set(street.frame_index.tolist()) == set(range(4))


def test_a_moving_actor_gets_points_on_its_box(prepared):
    (actor,) = prepared.lidar_map.actors.values()
    share = actor.xyz_m.abs() / (CAR_SIZE_M / 2)
    assert float(share.amax(dim=1).min()) == pytest.approx(0.95)
    assert float(actor.has_colour.float().mean()) > 0.2
    seen = actor.rgb_u8[actor.has_colour].float()
    assert float(seen.median()) == pytest.approx(26, abs=6)


def test_no_pixel_pretends_to_have_been_measured(prepared):
    assert all(not bool(view.lidar_depth_m.any()) for view in prepared.views)
    assert all(float(view.sky_mask.float().mean()) < 0.05 for view in prepared.views)


def test_a_blown_sky_has_no_depth():
    class BlownSky(WallDrive):
        def read_image(self, view):
            image = super().read_image(view)
            image[:60] = 255
            return image

    street, config = BlownSky(), ObservationConfig(width_px=160)
    found = prepare_observations(street, split_views(street, "all"), config)
    assert all(float(view.sky_mask[:25].float().mean()) > 0.9 for view in found.views)
    off_m = (found.lidar_map.street.xyz_m[:, 0] - WALL_X_M).abs()
    assert float((off_m < 0.05 * WALL_X_M).float().mean()) > 0.9


def test_images_from_one_place_are_one_clear_error():
    street = ToyStreet()
    street.sweeps = ()
    with pytest.raises(SceneError, match="toy/street: no LiDAR point within 300 m, and no depth"):
        prepare_observations(street, split_views(street, "all"), ObservationConfig(width_px=120))


def test_a_frame_that_no_lidar_swept_takes_its_sky_from_the_nearest():
    street = ToyStreet()
    # poses are exact, and sweeps that differ would move them by what float32 leaves
    config = ObservationConfig(width_px=240, registers_sweeps=False)
    swept = prepare_observations(street, split_views(street, "all"), config)
    street.sweeps = tuple(sweep for sweep in street.sweeps if sweep.frame_index != 2)
    gap = prepare_observations(street, split_views(street, "all"), config)
    assert not bool(gap.views[2].lidar_depth_m.any())
    differs = gap.views[2].sky_mask != swept.views[2].sky_mask
    assert float(differs.float().mean()) < 0.02
    assert bool(swept.views[2].sky_mask.any())
    assert torch.equal(gap.views[1].lidar_depth_m, swept.views[1].lidar_depth_m)
