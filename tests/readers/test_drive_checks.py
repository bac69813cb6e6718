"""A log that no car recorded is refused with the file of what cannot be; nothing is stored."""

import numpy as np
import pytest

from lidarpainter_models.errors import DataError


@pytest.fixture
def refusal(pandaset, tmp_path):
    """The one line with which the small log is refused once a test has changed it."""

    def refused():
        with pytest.raises(DataError) as raised:
            pandaset.ingest(tmp_path / "store")
        assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []
        message = str(raised.value)
        assert message.count(str(pandaset.path)) == 1, message
        return message

    return refused


UPRIGHT = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
"""A heading with which a camera looks into the sky."""


@pytest.mark.parametrize(
    ("name", "change", "complaint"),
    [
        (
            "lidar/poses",
            lambda poses: poses[2]["position"].update(x=110.0),
            "frame 2, pose: the vehicle has moved",
        ),
        (
            "lidar/poses",
            lambda poses: poses[1]["heading"].update(UPRIGHT),
            "frame 1, pose: the vehicle has moved 1.0 m and turned 0.79 rad in 0.100 s",
        ),
        (
            "camera/left_camera/timestamps",
            lambda times_s: [time_s + 0.5 for time_s in times_s],
            "left_camera/00.jpg: taken +0.5",
        ),
        (
            "camera/left_camera/timestamps",
            lambda times_s: [times_s[0] + 0.05] * len(times_s),
            "left_camera/01.jpg: taken at",
        ),
        (
            "camera/back_camera/poses",
            lambda poses: poses[1]["position"].update(x=140.0),
            "back_camera/01.jpg: the sensor is 3",
        ),
        (
            "camera/right_camera/poses",
            lambda poses: [{**pose, "heading": UPRIGHT} for pose in poses],
            "right_camera/00.jpg: no LiDAR point falls into any image of right_camera",
        ),
        (
            "camera/front_camera/intrinsics",
            lambda lens: lens.update(cx=1e5),
            "front_camera/00.jpg: no LiDAR point falls into any image",
        ),
    ],
    ids=["jump", "spin", "other time", "time stands still", "off the car", "sky", "past its image"],
)
def test_what_no_car_records_is_refused(pandaset, refusal, name, change, complaint):
    pandaset.edit_json(f"{name}.json", change)
    assert complaint in refusal()


def test_point_beyond_the_reach_of_a_lidar(pandaset, refusal):
    def throw(xyz_m):
        xyz_m[7, 2] += 5000.0
        return xyz_m

    pandaset.edit_points(1, throw)
    assert "lidar/01.pkl.gz: a point is 4998 m from its LiDAR, expected 1000 m" in refusal()


def test_points_of_chance(pandaset, refusal):
    rng = np.random.default_rng(0)
    pandaset.edit_points(1, lambda xyz_m: xyz_m + rng.uniform(-50, 50, xyz_m.shape))
    assert "lidar/01.pkl.gz: the points lie" in refusal()


@pytest.fixture
def raise_boxes(pandaset):
    """Writes a longer log and lifts the boxes of some frames off the points."""

    def lifted(frames, *, num_frames=6):
        pandaset.num_frames = num_frames
        pandaset.write_log()
        for index in frames:
            boxes = pandaset.boxes_at(pandaset.frame_times_s()[index])
            raised = [{**box, "centre": box["centre"] + np.array([0, 0, 9.0])} for box in boxes]
            pandaset.write_boxes(index, raised)

    return lifted


def test_moving_boxes_that_never_hold_points(raise_boxes, refusal):
    raise_boxes(range(6))
    assert "002: none of 6 boxes of moving actors within 40 m that a LiDAR could hit" in refusal()


@pytest.mark.parametrize(("frames", "num_frames"), [(range(5), 6), (range(4), 4)])
def test_some_empty_boxes_are_left_to_the_doctor(
    raise_boxes, pandaset, tmp_path, frames, num_frames
):
    raise_boxes(frames, num_frames=num_frames)
    assert pandaset.ingest(tmp_path / "store").is_dir()


def test_camera_that_sees_points_in_one_image_is_taken(pandaset, tmp_path):
    name = "camera/right_camera/poses.json"
    pandaset.edit_json(name, lambda poses: poses[0]["heading"].update(UPRIGHT))
    assert pandaset.ingest(tmp_path / "store").is_dir()
