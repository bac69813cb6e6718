"""Images with poses, sweeps and films, opened by pycolmap, plyfile, open3d and OpenCV."""

import json

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from gaussian_world import camera_at, map_points, turned_camera
from plyfile import PlyData

from lidarpainter_models.errors import ConfigError, WriteError
from lidarpainter_models.export import datasets
from lidarpainter_models.export.datasets import (
    PosedImage,
    map_sample,
    write_colmap,
    write_nerfstudio,
)
from lidarpainter_models.export.lidar_files import WrittenSweep, points_lidar, write_sweep
from lidarpainter_models.export.videos import images_per_second, video_file
from lidarpainter_models.scenes.records import Sweep, SweepPoints

POINTS = torch.tensor([[8.0, 1.0, 1.5], [9.0, -2.0, 0.5], [12.0, 0.5, 2.0]])
RGB = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.2, 0.4, 0.6]])
IMAGES = [
    PosedImage(name="front/0000.jpg", camera=camera_at(0.0), timestamp_ns=0),
    PosedImage(name="front/0001.jpg", camera=camera_at(1.0), timestamp_ns=100),
    PosedImage(name="left/0000.png", camera=turned_camera(0.4), timestamp_ns=0),
    PosedImage(name="wide/0000.png", camera=camera_at(0.0, width_px=80), timestamp_ns=0),
]


def test_pycolmap_projects_the_points_where_we_do(tmp_path):
    write_colmap(tmp_path, IMAGES, map_points(POINTS, RGB))
    found = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert (len(found.cameras), len(found.images)) == (2, 4)  # front and left share a lens
    by_name = {image.name: image for image in found.images.values()}
    for image in IMAGES:
        ours, depth_m = image.camera.project(POINTS.double())
        theirs = [by_name[image.name].project_point(point.numpy()) for point in POINTS.double()]
        assert bool((depth_m > 0).all())
        np.testing.assert_allclose(np.stack(theirs), ours.numpy(), atol=1e-6)
    colours = {tuple(point.xyz): tuple(point.color) for point in found.points3D.values()}
    assert colours[8.0, 1.0, 1.5] == (255, 0, 0)


def test_nerfstudio_looks_along_minus_z_with_y_up(tmp_path):
    write_nerfstudio(tmp_path, IMAGES, map_points(POINTS, RGB))
    found = json.loads((tmp_path / "transforms.json").read_text())
    assert found["camera_model"] == "OPENCV"
    for image, frame in zip(IMAGES, found["frames"], strict=True):
        assert frame["file_path"] == f"images/{image.name}"
        world_from_opengl = np.array(frame["transform_matrix"])
        points = np.c_[POINTS.numpy(), np.ones(3)] @ np.linalg.inv(world_from_opengl).T
        x, y, z = points[:, 0], -points[:, 1], -points[:, 2]
        u = frame["fl_x"] * x / z + frame["cx"]
        v = frame["fl_y"] * y / z + frame["cy"]
        ours, _ = image.camera.project(POINTS.double())
        np.testing.assert_allclose(np.stack([u, v], axis=1), ours.numpy(), atol=1e-4)
    start = PlyData.read(tmp_path / found["ply_file_path"])["vertex"]
    assert (start["x"][2], start["green"][1]) == (12.0, 255)


def test_a_large_map_is_thinned_to_what_others_take(monkeypatch):
    monkeypatch.setattr(datasets, "MAX_POINTS", 2)
    kept = map_sample(map_points(POINTS, RGB))
    assert len(kept) == 2
    assert torch.equal(kept.xyz_m, map_sample(map_points(POINTS, RGB)).xyz_m)


# --- sweeps


def one_sweep():
    points = SweepPoints.of(
        POINTS,
        intensity=torch.tensor([0.1, 0.5, 0.9]),
        time_offset_ns=torch.tensor([-5, 0, 7], dtype=torch.int32),
        ring=torch.tensor([3, 2, 1], dtype=torch.int16),
    )
    pose = turned_camera(0.3).world_from_camera
    sweep = Sweep(
        frame_index=0,
        lidar_name="top",
        timestamp_ns=0,
        world_from_lidar=pose,
        offset=0,
        num_points=3,
    )
    return sweep, points


def test_open3d_reads_a_sweep_in_the_frame_of_its_sensor(tmp_path):
    import open3d

    sweep, points = one_sweep()
    write_sweep(tmp_path / "a.pcd", WrittenSweep(sweep=sweep, points=points), "pcd")
    found = open3d.t.io.read_point_cloud(str(tmp_path / "a.pcd"))
    local = torch.from_numpy(found.point.positions.numpy())
    back = local.double() @ sweep.world_from_lidar[:3, :3].T + sweep.world_from_lidar[:3, 3]
    torch.testing.assert_close(back.float(), POINTS, atol=1e-5, rtol=0)
    np.testing.assert_array_equal(found.point["ring"].numpy()[:, 0], [3, 2, 1])
    np.testing.assert_array_equal(found.point["time_offset_ns"].numpy()[:, 0], [-5, 0, 7])
    np.testing.assert_allclose(found.point["intensity"].numpy()[:, 0], [0.1, 0.5, 0.9])


def test_the_form_of_nuscenes_is_five_floats_a_point(tmp_path):
    sweep, points = one_sweep()
    write_sweep(tmp_path / "a.pcd.bin", WrittenSweep(sweep=sweep, points=points), "pcd.bin")
    table = np.fromfile(tmp_path / "a.pcd.bin", dtype=np.float32).reshape(-1, 5)
    np.testing.assert_array_equal(table[:, :3], points_lidar(sweep, points).numpy())
    np.testing.assert_array_equal(table[:, 4], [3, 2, 1])


# --- films


def test_opencv_plays_a_film_of_an_odd_size(tmp_path):
    colours = [(0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9)]
    with video_file(tmp_path / "a.mp4", 12.5) as film:
        for rgb in colours:
            film.add(torch.tensor(rgb).expand(33, 65, 3))
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    kind = int(film.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
    assert kind in (b"avc1", b"h264")
    for rgb in colours:
        is_there, bgr = film.read()
        assert is_there
        assert bgr.shape == (32, 64, 3)
        np.testing.assert_allclose(bgr.mean((0, 1))[::-1] / 255, rgb, atol=0.03)
    assert not film.read()[0]


def test_films_run_as_fast_as_the_recording():
    assert images_per_second([0, 100_000_000, 200_000_000, 900_000_000]) == 10.0
    assert images_per_second([5]) == 10.0


def film_that_breaks_off(path):
    with video_file(path, 10) as film:
        film.add(torch.zeros(32, 32, 3))
        raise RuntimeError("out of colour")


def test_a_film_that_breaks_off_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="out of colour"):
        film_that_breaks_off(tmp_path / "a.mp4")
    with pytest.raises(ConfigError, match="--fps 0"), video_file(tmp_path / "a.mp4", 0):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(WriteError, match="cannot be written"):
        film_that_breaks_off(tmp_path / "file" / "a.mp4")
