from dataclasses import replace

import pytest
import torch
from gaussian_world import camera_at, car_track

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.geometry.cameras import Shutter
from lidarpainter_models.scenes.camera_faults import CameraFault
from lidarpainter_models.scenes.ego_corrections import EgoCorrections


def two_cameras():
    keys = [(0, "front"), (1, "front"), (0, "left"), (1, "left")]
    poses = torch.stack([camera_at(x).world_from_camera for x in (0.0, 1.0, 0.0, 1.0)])
    times = torch.tensor([0, 100, 50, 150]) * 1_000_000
    return CameraCorrections.none(keys, times, poses)


def test_recentring_changes_no_pose_and_empties_the_mean():
    cameras = two_cameras()
    cameras.view_tangent.add_(0.01 * torch.randn(4, 6).double())
    before = torch.stack([cameras.world_from_camera(row) for row in range(4)])
    cameras.recentre()
    after = torch.stack([cameras.world_from_camera(row) for row in range(4)])
    assert torch.allclose(before, after, atol=1e-12)
    assert float(cameras.view_tangent[:2].mean(0).abs().max()) < 1e-15
    assert float(cameras.camera_tangent.abs().max()) > 0


def test_camera_without_training_views_stays_as_recorded():
    cameras = two_cameras()
    cameras.view_tangent.add_(0.01)
    camera = camera_at(0.5)
    found = cameras.refined(camera, (0, "back"), 0)
    assert found is camera


def rising(times_ns=(0, 100_000_000)):
    """Poses that recorded nothing of how the car rose by half a metre and turned."""
    tangent = torch.zeros(2, 6, dtype=torch.float64)
    tangent[1, 2], tangent[1, 5] = 0.01, 0.5
    return EgoCorrections(
        times_ns=torch.tensor(times_ns), centre_m=torch.zeros(2, 3).double(), tangent=tangent
    )


def test_a_held_out_view_stands_where_its_sweep_says():
    path = rising()
    cameras = two_cameras()
    poses = [
        path.at(time_ns) @ pose
        for time_ns, pose in zip(
            cameras.timestamps_ns.tolist(), cameras.recorded_world_from_camera, strict=True
        )
    ]
    cameras = replace(cameras, recorded_world_from_camera=torch.stack(poses), path=path)
    camera = camera_at(0.5)
    found = cameras.refined(camera, (7, "front"), 50_000_000).world_from_camera
    expected = path.at(50_000_000) @ camera.world_from_camera
    assert float(expected[2, 3]) == pytest.approx(1.25)
    torch.testing.assert_close(found, expected)
    trained = cameras.refined(camera, (1, "front"), 100_000_000).world_from_camera
    torch.testing.assert_close(trained, poses[1])


def test_what_sweeps_say_is_told_where_it_matters():
    path = rising()
    assert path.in_words() == []
    tangent = path.tangent.clone()
    tangent[:, 0] = 2e-3
    (said,) = replace(path, tangent=tangent).in_words()
    assert "turned by 0.11 degrees (median)" in said


def test_a_camera_that_no_fit_saw_rides_with_one_that_it_saw():
    cameras = replace(two_cameras(), path=rising())
    seen, other = camera_at(0.5), camera_at(3.0)
    alone = cameras.riding(other, 50_000_000, seen, (7, "front"), 50_000_000)
    torch.testing.assert_close(
        alone.world_from_camera, cameras.refined(other, (7, "back"), 50_000_000).world_from_camera
    )
    cameras.camera_tangent[0, 3:] = torch.tensor([0.0, 0.2, 0.0]).double()  # down
    moved = cameras.riding(other, 50_000_000, seen, (7, "front"), 50_000_000)
    lift_m = (moved.world_from_camera - alone.world_from_camera)[2, 3]
    assert float(lift_m) == pytest.approx(-0.2, abs=0.03)


def test_constant_of_a_camera_reaches_its_other_times():
    cameras = two_cameras()
    cameras.camera_tangent[1, 1] = 0.02
    camera = camera_at(0.5)
    turned = cameras.refined(camera, (7, "left"), 1)
    same = cameras.refined(camera, (7, "front"), 1)
    assert (turned.world_from_camera - camera.world_from_camera).abs().max() > 0.01
    assert torch.allclose(same.world_from_camera, camera.world_from_camera, atol=1e-9)


def test_actor_corrections_are_linear_between_knots_and_constant_beyond():
    actors = Actors.uncorrected([car_track(4)], torch.tensor([100, 300, 200]))
    actors.tangent[0, :, 0] = torch.tensor([1.0, 2.0, 4.0]).double()
    found = [float(actors.tangent_at(time)[0, 0]) for time in (0, 100, 150, 250, 300, 999)]
    assert found == [1.0, 1.0, 1.5, 3.0, 4.0, 4.0]


def test_a_correction_is_held_against_the_knots_beside_it():
    actors = Actors.uncorrected([car_track(4)], torch.tensor([100, 200, 300, 400]))
    found = [actors.knots_beside(time) for time in (100, 200, 250, 300, 400, 999)]
    assert found == [{0, 1}, {0, 2}, {0, 3}, {1, 3}, {2, 3}, {2, 3}]


def test_exposure_of_an_unknown_camera_is_neutral():
    exposure = ExposureCorrections.none(["front"], [0])
    exposure.matrix[0, :, 3] = 0.1
    rgb = torch.rand(3, 4, 3)
    assert torch.equal(exposure.apply(rgb, None, 0), rgb)
    assert torch.allclose(exposure.apply(rgb, "front", 0), rgb + 0.1)


def test_gain_is_linear_between_knots_and_constant_beyond():
    second = 1_000_000_000
    exposure = ExposureCorrections.none(["front"], [5 * second, 7 * second])
    exposure.log_gain[0] = torch.tensor([0.0, 0.2, 0.1])
    grey = torch.full((1, 1, 3), 0.5)
    times_s = (0.0, 5.0, 5.5, 6.5, 7.0, 9.0)
    shown = [float(exposure.apply(grey, "front", round(t * second))[0, 0, 0]) for t in times_s]
    expected = (0.5 * torch.tensor([0.0, 0.0, 0.1, 0.15, 0.1, 0.1]).exp()).tolist()
    assert shown == pytest.approx(expected, rel=1e-5)


def test_exposure_begins_as_images_show_colours():
    """Of the right camera every image is half as red; that of second 1 is darker as well."""
    second, names = 1_000_000_000, ["left"] * 3 + ["right"] * 3
    shown = torch.ones(6, 3)
    shown[3:, 0] = 0.5
    shown[4] *= 0.8
    order = [4, 0, 1, 5, 2, 3]  # not that of time
    exposure = ExposureCorrections.measured(
        ["left", "right"],
        [names[index] for index in order],
        [index % 3 * second for index in order],
        shown[order],
    )
    found = [exposure.map_at("right", time * second) for time in range(3)]
    for now, gain in zip(found, (1.0, 0.8, 1.0), strict=True):
        assert now[:, :3].diag().tolist() == pytest.approx([0.5 * gain, gain, gain], rel=1e-5)
        assert not now[:, 3].any()
    assert torch.equal(exposure.map_at("left", second), torch.eye(3, 4))
    assert float(exposure.log_gain.mean(dim=1).abs().max()) < 1e-6
    early = ExposureCorrections.measured(["left"], ["left"] * 2, [0, 1], 0.5 * torch.ones(2, 3))
    assert early.map_at("left", 1)[:, :3].diag().tolist() == pytest.approx([0.5] * 3)


def test_exposure_is_undone():
    exposure = ExposureCorrections.none(["front"], [0, 2_000_000_000])
    exposure.matrix[0, :, 3] = 0.1
    exposure.log_gain[0, 1] = 0.3
    rgb = torch.rand(3, 4, 3)
    taken = exposure.apply(rgb, "front", 900_000_000)
    assert torch.allclose(exposure.undone(taken, "front", 900_000_000), rgb, atol=1e-6)
    assert not torch.allclose(taken, rgb, atol=0.05)


def test_a_fault_of_a_camera_reaches_its_other_times():
    cameras = replace(two_cameras(), faults={"left": CameraFault(late_s=0.05)})
    moving = Shutter(twist_per_s=torch.tensor([0.0, 0, 0, 0, 0, 10.0], dtype=torch.float64))
    camera = replace(camera_at(0.5), shutter=moving)
    late = cameras.refined(camera, (7, "left"), 1)
    sound = cameras.refined(camera, (7, "front"), 1)
    assert float(late.centre_world[0]) == pytest.approx(1.0)
    assert late.taken_ns(0) == 50_000_000
    assert float(sound.centre_world[0]) == pytest.approx(0.5)
