"""A sample of the held-out views stands for all of them: every camera, the whole drive."""

import pytest
from toy_street import ToyStreet

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.observations.settings import ObservationConfig

CAMERAS = ("front", "left", "right")


def held_out(num_frames):
    street = ToyStreet(num_frames, tuple((name, 1.0) for name in CAMERAS))
    return HeldOut(scene=street, test_views=street.views, observation=ObservationConfig())


def frames_of(sample, name):
    return [view.frame_index for view in sample.test_views if view.camera_name == name]


@pytest.mark.parametrize("most", [0, 42, 100])
def test_few_views_are_all_judged(most):
    everything = held_out(14)
    assert everything.sampled(most) is everything


def test_a_sample_is_even_over_cameras_and_time():
    sample = held_out(100).sampled(30)
    for name in CAMERAS:
        assert frames_of(sample, name) == list(range(5, 100, 10))
    frames = [view.frame_index for view in sample.test_views]
    assert frames == sorted(frames)


def test_every_camera_is_judged_however_small_the_sample():
    sample = held_out(9).sampled(2)
    assert [frames_of(sample, name) for name in CAMERAS] == [[4], [4], [4]]
