"""Frames are split by position, and every camera of a frame goes the same way."""

import pytest

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.scenes.splits import rows_of_each, sampled_rows, split_frames, split_views


def test_alternate_frames_train_and_test():
    train, test = split_frames(range(28), "alternate")
    assert train == tuple(range(0, 28, 2))
    assert test == tuple(range(1, 28, 2))


def test_linspace_is_the_split_of_neurad_studio():
    train, test = split_frames(range(80), "linspace")
    assert (train[:3], train[-3:]) == ((0, 2, 4), (74, 76, 79))
    assert (test[0], test[-3:], len(test)) == (1, (75, 77, 78), 40)


def test_forward_split_trains_behind_and_tests_ahead():
    train, test = split_frames(range(28), "forward:17:8")
    assert train == (0, 2, 4, 6, 8, 10, 12, 14, 16)
    assert test == tuple(range(20, 28))


@pytest.mark.parametrize("spec", ["alternate", "forward:24:8"])
@pytest.mark.parametrize(
    "has_image",
    [
        lambda frame, camera: (frame + camera) % 2 == 0,  # two cameras take turns
        lambda frame, camera: camera == 0 or frame % 2 == 0,  # one runs at half the rate
        lambda frame, _camera: frame % 2 == 0,  # images in every second frame alone
        lambda frame, camera: (frame + camera) % 3 == 0,
    ],
)
def test_every_camera_trains_on_half_of_its_images_and_is_tested_on_others(spec, has_image):
    seen_by = {
        frame: [str(camera) for camera in range(3) if has_image(frame, camera)]
        for frame in range(48)
    }
    train, test = split_frames(range(48), spec, seen_by)
    assert not set(train) & set(test)
    for camera in {name for names in seen_by.values() for name in names}:
        trained = sum(camera in seen_by[frame] for frame in train)
        own = sum(camera in seen_by[frame] for frame in range(48 if spec == "alternate" else 24))
        assert abs(trained - own / 2) <= 2
        assert any(camera in seen_by[frame] for frame in test)


def test_a_camera_that_misses_an_image_changes_nothing_for_the_others():
    cameras = [str(camera) for camera in range(6)]
    seen_by = {frame: cameras[1:] if frame == 3 else cameras for frame in range(28)}
    assert split_frames(range(28), "alternate", seen_by) == split_frames(range(28), "alternate")


def test_a_split_that_leaves_no_image_to_train_on_is_refused():
    with pytest.raises(ConfigError, match="leaves no frame with an image to train on"):
        split_frames(range(4), "alternate", {})


def test_all_holds_nothing_out():
    assert split_frames(range(3), "all") == ((0, 1, 2), ())


def test_positions_count_and_not_frame_numbers():
    assert split_frames([11, 13, 15, 18], "alternate") == ((11, 15), (13, 18))


@pytest.mark.parametrize(
    "spec", ["", "odd", "alternate:2", "forward", "forward:17", "forward:a:b", "forward:-1:3"]
)
def test_unknown_spec_names_the_known_ones(spec):
    with pytest.raises(ConfigError, match="expected alternate, linspace, forward:N:M or all"):
        split_frames(range(28), spec)


@pytest.mark.parametrize("spec", ["forward:20:9", "forward:0:3", "forward:3:0"])
def test_forward_split_that_does_not_fit_is_refused(spec):
    with pytest.raises(ConfigError, match="the scene has 28 frames"):
        split_frames(range(28), spec)


def test_no_frame_to_train_on_is_refused():
    with pytest.raises(ConfigError, match="leaves no frame"):
        split_frames([], "alternate")


def test_views_of_a_scene_follow_their_frames(small_scene):
    split = split_views(small_scene, "alternate", ("front_camera", "left_camera"))
    assert {view.key for view in split.train} == {
        (frame, camera) for frame in (0, 2) for camera in ("front_camera", "left_camera")
    }
    assert {view.frame_index for view in split.test} == {1}
    assert (split.train_frames, split.test_frames) == ((0, 2), (1,))


def test_all_cameras_are_split_unless_named(small_scene):
    assert len(split_views(small_scene, "all").train) == 18


def test_unknown_camera_is_refused(small_scene):
    with pytest.raises(SceneError, match="no camera 'roof'; it has front_camera"):
        split_views(small_scene, "all", ("roof",))


@pytest.mark.parametrize("num_cameras", [1, 2, 4, 6])
def test_cameras_that_take_turns_are_all_among_some_views(num_cameras):
    cameras = [str(camera) for _frame in range(14) for camera in range(num_cameras)]
    for most in (num_cameras, 16, 24):
        rows = sampled_rows(cameras, most)
        assert len(rows) <= max(most, num_cameras)
        assert {cameras[row] for row in rows} == set(cameras)
        assert rows == sorted(set(rows))
    assert sampled_rows(cameras, len(cameras)) == list(range(len(cameras)))


def test_of_each_camera_rows_are_taken_evenly():
    assert rows_of_each(list("ababababac"), 2) == [2, 3, 6, 7, 9]
