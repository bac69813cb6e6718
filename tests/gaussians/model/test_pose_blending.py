import math

import torch

from lidarpainter_models.gaussians.model.pose_blending import RefinedTracks, tangent_from_rigid
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


def moving(x_m):
    """Poses that stand along x."""
    poses = torch.eye(4).double().repeat(len(x_m), 1, 1)
    poses[:, 0, 3] = x_m
    return poses


def track_of(times_s, recorded, refined):
    return RefinedTracks.of([times_s], [recorded], [refined])


def test_motion_between_refined_times_is_a_cubic():
    times_s = torch.tensor([0.0, 0.2, 0.4, 0.7, 1.0, 1.1, 1.3]).double()
    jitter = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0]).double()
    refined = moving(times_s**3 - 2 * times_s)
    track = track_of(times_s, moving(times_s**3 - 2 * times_s + jitter), refined)
    found = track.pose_at(0, 0.5, moving(torch.tensor([40.0]).double())[0])
    assert abs(float(found[0, 3]) - (0.125 - 1.0)) < 1e-6  # what was recorded is not believed


def test_smooth_motion_is_interpolated_closely():
    times_s = torch.arange(0, 2, 0.2).double()
    track = track_of(times_s, noisy(drive(times_s), 0.05), drive(times_s))
    found = track.pose_at(0, 0.9, noisy(drive(torch.tensor([0.9])), 0.05, seed=1)[0])
    assert rotation_error(found, drive(torch.tensor([0.9]))[0]) < 2e-3


def test_bodies_asked_together_answer_as_when_asked_alone():
    """Tracks of 1 to 9 times, each asked at, between and beyond its times."""
    lengths = (9, 1, 5, 2, 3, 4, 7)
    tracks = []
    for seed, length in enumerate(lengths):
        times_s = 0.3 * seed + torch.arange(length).double() * 0.2
        truth = drive(times_s)
        tracks.append((times_s, noisy(truth, 0.01, seed), noisy(truth, 1e-4, seed + 50)))
    together = RefinedTracks.of(*zip(*tracks, strict=True))
    bodies = torch.arange(len(lengths)).repeat_interleave(40)
    query_s = torch.linspace(-0.5, 4.5, 40).double().repeat(len(lengths))
    query_s[::7] = torch.stack([tracks[int(body)][0][-1] for body in bodies[::7]])
    recorded = noisy(drive(query_s), 0.01, seed=99)
    found = together.poses_at(bodies, query_s, recorded)
    for row, body in enumerate(bodies.tolist()):
        alone = track_of(*tracks[body]).pose_at(0, float(query_s[row]), recorded[row])
        assert torch.allclose(found[row], alone, atol=1e-9)


def test_refined_times_give_refined_poses():
    times_s = torch.arange(0, 2, 0.2).double()
    truth = drive(times_s)
    recorded = noisy(truth, 1e-3)
    track = track_of(times_s, recorded, truth)
    found = track.pose_at(0, float(times_s[3]), recorded[3])
    assert torch.allclose(found, truth[3], atol=1e-9)


def test_jitter_of_recorded_poses_is_smoothed_away():
    times_s = torch.arange(0, 4, 0.2).double()
    middle_s = times_s[:-1] + 0.1
    truth, test_truth = drive(times_s), drive(middle_s)
    recorded, test_recorded = noisy(truth, 2e-3), noisy(test_truth, 2e-3, seed=1)
    track = track_of(times_s, recorded, truth)
    inner = range(2, len(middle_s) - 2)
    blended = sum(
        rotation_error(track.pose_at(0, float(middle_s[i]), test_recorded[i]), test_truth[i])
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
    track = track_of(times_s, truth @ undo, truth)
    found = track.pose_at(0, float(middle_s[7]), test_truth[7] @ undo)
    assert rotation_error(found, test_truth[7]) < 5e-4


def test_single_refined_pose_corrects_by_its_own_correction():
    pose = drive(torch.tensor([0.0]))
    offset = rigid_from_tangent(torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.0]).double())
    track = track_of(torch.zeros(1).double(), pose, pose @ offset)
    found = track.pose_at(0, 0.3, pose[0])
    assert torch.allclose(found, pose[0] @ offset, atol=1e-9)
