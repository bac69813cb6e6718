"""Change from frame to frame, on a wall that a camera drives past."""

from dataclasses import replace

import pytest
import torch

from lidarpainter_models.evaluation.flicker import TRUTH, FlickerFrame, FlickerTally
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.tracks import ActorTrack

WALL_M, FOCAL_PX, SIZE_PX = 10.0, 60.0, (48, 64)
STEP_NS = 100_000_000


def camera_at(y_m):
    """Looks along world x from a place left (y) of the origin."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[1, 3] = y_m
    height_px, width_px = SIZE_PX
    return Camera.centred(pose, FOCAL_PX, width_px=width_px, height_px=height_px)


def wall_frame(y_m, step=0, tint=0.0, moved_m=0.0):
    """A wall whose colours are linear in world y, so that resampling costs nothing."""
    camera = camera_at(y_m)
    depth_m = torch.full(SIZE_PX, WALL_M)
    wall_y_m = camera.unproject(depth_m)[..., 1].float() - moved_m
    rgb = (0.5 + 0.04 * wall_y_m[..., None]).expand(-1, -1, 3)
    return FlickerFrame(
        camera=camera,
        timestamp_ns=step * STEP_NS,
        depth_m=depth_m,
        alpha=torch.ones(SIZE_PX),
        images={"steady": rgb, "tinted": rgb + tint, TRUTH: rgb},
    )


def scores_of(frames, tracks=()):
    tally = FlickerTally(tracks)
    for frame in frames:
        tally.add(frame)
    return tally.scores()


def test_a_still_wall_does_not_flicker_and_a_changing_tint_does():
    found = scores_of([wall_frame(0.3 * step, step, tint=0.1 * (step % 2)) for step in range(4)])
    assert found["steady"].flicker == pytest.approx(0, abs=1e-5)
    assert found["tinted"].flicker == pytest.approx(0.1, abs=1e-4)
    assert found["steady"].num_pairs == 3
    # 0.3 m at 10 m and 60 px of focal length: 1.8 of 64 columns are new, and half a pixel of rim
    assert found["steady"].valid_share == pytest.approx(1 - 2.3 / 64, abs=0.02)
    assert found["tinted"].moving_flicker is None


def test_the_truth_is_only_compared_with_itself_in_time():
    found = scores_of([wall_frame(0.0, 0, tint=0.1), wall_frame(0.1, 1, tint=0.1)])
    assert found[TRUTH].psnr is None
    assert found["steady"].psnr == float("inf")
    assert found["tinted"].psnr == pytest.approx(20.0, abs=1e-3)


def test_surfaces_that_only_one_view_shows_are_not_compared():
    first, second = wall_frame(0.0, 0), wall_frame(0.0, 1, tint=0.5)
    nearer = replace(second, depth_m=torch.full(SIZE_PX, 5.0))
    found = scores_of([first, nearer])
    assert found["tinted"].flicker is None
    assert found["tinted"].valid_share == 0


def test_what_moves_with_its_box_is_followed():
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[0, :3, 3] = torch.tensor([WALL_M, 0.0, 0.0])
    poses[1, :3, 3] = torch.tensor([WALL_M, 1.0, 0.0])
    wall = ActorTrack(
        actor_id="wall",
        category="Car",
        is_moving=True,
        size_m=torch.tensor([4.0, 40.0, 40.0]),
        frame_indices=torch.tensor([0, 1]),
        timestamps_ns=torch.tensor([0, STEP_NS]),
        world_from_box=poses,
        num_points=torch.tensor([100, 100]),
    )
    frames = [wall_frame(0.0, 0), wall_frame(0.0, 1, moved_m=1.0)]
    followed, left_behind = scores_of(frames, [wall]), scores_of(frames)
    assert followed["steady"].moving_flicker == pytest.approx(0, abs=1e-5)
    assert left_behind["steady"].flicker == pytest.approx(0.04, abs=1e-4)


def test_a_single_frame_has_nothing_to_be_compared_with():
    found = scores_of([wall_frame(0.0)])["steady"]
    assert (found.flicker, found.num_pairs, found.valid_share) == (None, 0, 0)
