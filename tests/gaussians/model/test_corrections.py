import torch
from gaussian_world import camera_at, car_track

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections


def two_cameras():
    keys = [(0, "front"), (1, "front"), (0, "left"), (1, "left")]
    poses = torch.stack([camera_at(x).world_from_camera for x in (0.0, 1.0, 0.0, 1.0)])
    times = torch.tensor([0, 100, 50, 150]) * 1_000_000
    return CameraCorrections.none(keys, times, poses)


def test_recentring_changes_no_pose_and_empties_the_mean():
    cameras = two_cameras()
    cameras.view_tangent.add_(0.01 * torch.randn(4, 6).double())
    before = torch.stack([cameras.world_from_camera(row) for row in range(4)])
    cameras.recentre(keep_mean=True)
    after = torch.stack([cameras.world_from_camera(row) for row in range(4)])
    assert torch.allclose(before, after, atol=1e-12)
    assert float(cameras.view_tangent[:2].mean(0).abs().max()) < 1e-15
    assert float(cameras.camera_tangent.abs().max()) > 0


def test_recentring_without_keeping_drops_the_mean():
    cameras = two_cameras()
    cameras.view_tangent.add_(0.01)
    cameras.recentre(keep_mean=False)
    assert float(cameras.tangent(0).abs().max()) < 1e-15


def test_camera_without_training_views_stays_as_recorded():
    cameras = two_cameras()
    cameras.view_tangent.add_(0.01)
    camera = camera_at(0.5)
    found = cameras.corrected(camera, key=None, timestamp_ns=0, camera_name="back")
    assert found is camera


def test_constant_of_a_camera_reaches_its_other_times():
    cameras = two_cameras()
    cameras.camera_tangent[1, 1] = 0.02
    camera = camera_at(0.5)
    turned = cameras.corrected(camera, key=(7, "left"), timestamp_ns=1, camera_name="left")
    same = cameras.corrected(camera, key=(7, "front"), timestamp_ns=1, camera_name="front")
    assert (turned.world_from_camera - camera.world_from_camera).abs().max() > 0.01
    assert torch.allclose(same.world_from_camera, camera.world_from_camera, atol=1e-9)


def test_actor_corrections_are_linear_between_knots_and_constant_beyond():
    actors = Actors.uncorrected([car_track(4)], torch.tensor([100, 300, 200]))
    actors.tangent[0, :, 0] = torch.tensor([1.0, 2.0, 4.0]).double()
    found = [float(actors.tangent_at(time)[0, 0]) for time in (0, 100, 150, 250, 300, 999)]
    assert found == [1.0, 1.0, 1.5, 3.0, 4.0, 4.0]


def test_exposure_of_an_unknown_camera_is_neutral():
    exposure = ExposureCorrections.none(["front"])
    exposure.matrix[0, :, 3] = 0.1
    rgb = torch.rand(3, 4, 3)
    assert torch.equal(exposure.apply(rgb, None), rgb)
    assert torch.allclose(exposure.apply(rgb, "front"), rgb + 0.1)
