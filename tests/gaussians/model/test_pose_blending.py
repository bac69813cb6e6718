import math

import torch

from lidarpainter_models.gaussians.model.pose_blending import (
    RefinedTrack,
    interpolate_smoothly,
    lagrange_weights,
    tangent_from_rigid,
)
from lidarpainter_models.geometry.transforms import rigid_from_tangent


def drive(times_s):
    """A smooth ride: forward, with a slow nod."""
    return torch.stack(
        [
            rigid_from_tangent(
                torch.tensor(
                    [0.0, 0.02 * math.sin(2 * t), 0.01 * t, 5 * t, 0.1 * t * t, 0.0]
                ).double()
            )
            for t in times_s.tolist()
        ]
    )


def noisy(poses, size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    noise = size * torch.randn(poses.shape[0], 6, generator=generator).double()
    return poses @ rigid_from_tangent(noise)


def rotation_error(first, second):
    return float(tangent_from_rigid(torch.linalg.inv(first) @ second)[:3].norm())


def test_tangent_is_the_inverse_of_the_exponential():
    tangents = torch.tensor([[0.3, -0.2, 0.5, 1.0, 2.0, 3.0], [0.0] * 6, [1e-8, 0, 0, 0, 0, 0]])
    found = tangent_from_rigid(rigid_from_tangent(tangents.double()))
    assert torch.allclose(found, tangents.double(), atol=1e-12)


def test_cubic_weights_reproduce_a_cubic():
    times_s = torch.tensor([0.0, 0.2, 0.4, 0.7, 1.0]).double()
    values = times_s**3 - 2 * times_s
    rows, weights = lagrange_weights(times_s, 0.5)
    assert abs(float((weights * values[rows]).sum()) - (0.125 - 1.0)) < 1e-12


def test_outside_the_samples_the_line_goes_on():
    times_s = torch.tensor([0.0, 1.0, 2.0]).double()
    rows, weights = lagrange_weights(times_s, 3.0)
    values = torch.tensor([5.0, 1.0, 2.0]).double()
    assert abs(float((weights * values[rows]).sum()) - 3.0) < 1e-12


def test_smooth_motion_is_interpolated_closely():
    times_s = torch.arange(0, 2, 0.2).double()
    found = interpolate_smoothly(times_s, drive(times_s), 0.9)
    assert rotation_error(found, drive(torch.tensor([0.9]))[0]) < 1e-4


def test_refined_times_give_refined_poses():
    times_s = torch.arange(0, 2, 0.2).double()
    truth = drive(times_s)
    recorded = noisy(truth, 1e-3)
    track = RefinedTrack(times_s=times_s, recorded=recorded, refined=truth)
    found = track.pose_at(float(times_s[3]), recorded[3])
    assert torch.allclose(found, truth[3], atol=1e-9)


def test_jitter_of_recorded_poses_is_smoothed_away():
    times_s = torch.arange(0, 4, 0.2).double()
    middle_s = times_s[:-1] + 0.1
    truth, test_truth = drive(times_s), drive(middle_s)
    recorded, test_recorded = noisy(truth, 2e-3), noisy(test_truth, 2e-3, seed=1)
    track = RefinedTrack(times_s=times_s, recorded=recorded, refined=truth)
    inner = range(2, len(middle_s) - 2)
    blended = sum(
        rotation_error(track.pose_at(float(middle_s[i]), test_recorded[i]), test_truth[i])
        for i in inner
    )
    as_recorded = sum(rotation_error(test_recorded[i], test_truth[i]) for i in inner)
    assert blended < 0.3 * as_recorded


def test_constant_offset_of_rough_motion_is_carried_over():
    times_s = torch.arange(0, 4, 0.2).double()
    middle_s = times_s[:-1] + 0.1
    truth, test_truth = noisy(drive(times_s), 0.02), noisy(drive(middle_s), 0.02, seed=1)
    offset = rigid_from_tangent(torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.05]).double())
    undo = torch.linalg.inv(offset)
    track = RefinedTrack(times_s=times_s, recorded=truth @ undo, refined=truth)
    found = track.pose_at(float(middle_s[7]), test_truth[7] @ undo)
    assert rotation_error(found, test_truth[7]) < 5e-4


def test_single_refined_pose_corrects_by_its_own_correction():
    pose = drive(torch.tensor([0.0]))
    offset = rigid_from_tangent(torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.0]).double())
    track = RefinedTrack(times_s=torch.zeros(1).double(), recorded=pose, refined=pose @ offset)
    found = track.pose_at(0.3, pose[0])
    assert torch.allclose(found, pose[0] @ offset, atol=1e-9)
