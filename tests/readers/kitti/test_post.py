"""A raw drive of KITTI made by hand: a car passes a post, and a car drives ahead of it."""

import cv2
import numpy as np
import pytest
import torch

from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene


def write_drive(folder, num_frames=4):
    """A drive straight east at 10 m/s; a post stands 20 m ahead of the start, 5 m to the left."""
    drive = folder / "2011_09_26_drive_0001_sync"
    axes = "0 -1 0 0 0 -1 1 0 0"  # camera right, down, forward from LiDAR forward, left, up
    (folder / "calib_cam_to_cam.txt").parent.mkdir(parents=True)
    (folder / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        "R_rect_00: 1 0 0 0 1 0 0 0 1\n"
        "P_rect_02: 100 0 31.5 6 0 100 23.5 0 0 0 1 0\n"
    )
    (folder / "calib_velo_to_cam.txt").write_text(f"R: {axes}\nT: 0 -0.1 -0.3\n")
    (folder / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    for name in ("oxts/data", "image_02/data", "velodyne_points/data"):
        (drive / name).mkdir(parents=True)
    lines = []
    for index in range(num_frames):
        longitude = 8.4 + np.degrees(1.0 * index / 6378137.0) / np.cos(np.radians(49.0))
        (drive / f"oxts/data/{index:010d}.txt").write_text(
            f"49.0 {float(longitude)!r} 116.0 0 0 0 10 0"
        )
        lines.append(f"2011-09-26 13:02:25.{index}94360375")
        image = np.full((48, 64, 3), 40 * index, np.uint8)
        cv2.imwrite(str(drive / f"image_02/data/{index:010d}.png"), image)
        post = np.tile([20.0 - index, 5.0, 0.0, 0.5], (10, 1))
        post[:, 0] = post_x_m(index)  # the car is still moving
        post.astype("<f4").tofile(drive / f"velodyne_points/data/{index:010d}.bin")
    (drive / "oxts/timestamps.txt").write_text("\n".join(lines))
    around_post = [(post_x_m(index), 5.0, -0.75, 0.0) for index in range(num_frames)]
    ahead = [(10.0, -3.0, -1.5, 0.0)] * 9  # as fast as the car; more than there are frames
    (drive / "tracklet_labels.xml").write_text(
        tracklets(
            ("Car", (1.5, 1.8, 4.0), 0, around_post),
            ("Van", (2.0, 1.9, 5.0), 1, ahead),
            ("Tram", (3.0, 2.5, 9.0), num_frames, ahead),  # after the last frame
        )
    )
    return drive.name


def post_x_m(index):
    """Where the post stands before the car when the LiDAR looks at it."""
    return 20.0 - index + 0.5 - np.pi**-1 / 2 * (np.pi - np.arctan2(5.0, 20.0 - index))


def tracklets(*actors):
    """tracklet_labels.xml of actors: type, height width length, first frame, x y z yaw by frame."""
    items = ""
    for kind, (height_m, width_m, length_m), first, places in actors:
        poses = "".join(
            f"<item><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{yaw}</rz></item>"
            for x, y, z, yaw in places
        )
        items += (
            f"<item><objectType>{kind}</objectType><h>{height_m}</h><w>{width_m}</w>"
            f"<l>{length_m}</l><first_frame>{first}</first_frame>"
            f"<poses><count>{len(places)}</count>{poses}</poses></item>"
        )
    return (
        "<boost_serialization><tracklets><count>3</count><item_version>1</item_version>"
        f"{items}</tracklets></boost_serialization>"
    )


def test_in_a_drive_past_a_post_it_stands_still(tmp_path):
    drive = write_drive(tmp_path / "2011_09_26")
    scene = DrivingScene.open(ingest_scene("kitti", tmp_path, drive, tmp_path / "store"))
    travelled_m = scene.world_from_ego[:, 0, 3]
    assert torch.allclose(travelled_m, torch.arange(4).double(), atol=1e-3)
    for frame_index in (1, 2):  # the first and the last have a neighbour on one side only
        post_m = scene.read_points(frame_index).xyz_m.mean(dim=0)
        assert torch.allclose(post_m, torch.tensor([20.0, 5.0, 0.0]), atol=0.05)
    parked, moving = scene.tracks
    assert (parked.category, parked.is_moving, parked.size_m.tolist()) == (
        "Car",
        False,
        pytest.approx([4.0, 1.8, 1.5]),
    )
    assert torch.allclose(
        parked.world_from_box[1:3, :3, 3], torch.tensor([20.0, 5.0, 0.0]).double(), atol=0.01
    )
    assert parked.num_points[1:3].tolist() == [10, 10]
    assert (moving.category, moving.is_moving) == ("Van", True)
    assert moving.frame_indices.tolist() == [1, 2, 3]
    assert moving.num_points.tolist() == [0, 0, 0]
    seen_s = (moving.timestamps_ns - parked.timestamps_ns[1:]).double() / 1e9
    assert ((seen_s > 0.005) & (seen_s < 0.02)).all()  # it turns clockwise: left, then right
    step_m = moving.world_from_box[1, :3, 3] - moving.world_from_box[0, :3, 3]
    assert torch.allclose(step_m, torch.tensor([1.0, 0.0, 0.0]).double(), atol=0.01)
    camera = scene.views[0].camera
    assert (camera.fx_px, camera.cx_px) == (100.0, 32.0)
    # 6 cm beside camera 0, which is 0.3 m ahead of the LiDAR
    assert torch.allclose(
        camera.centre_world, torch.tensor([0.3, 0.06, -0.1]).double(), atol=1e-9
    ), camera.centre_world


def test_frame_without_a_turn_has_its_image_alone(tmp_path):
    drive = write_drive(tmp_path / "raw", num_frames=4)
    (tmp_path / "raw" / drive / "velodyne_points/data/0000000001.bin").unlink()
    (tmp_path / "raw" / drive / "velodyne_points/data/0000000002.bin").write_bytes(b"")
    scene = DrivingScene.open(ingest_scene("kitti", tmp_path / "raw", drive, tmp_path / "store"))
    assert [len(scene.sweeps_of(frame)) for frame in range(4)] == [1, 0, 0, 1]
    assert len(scene.views) == 4
