"""The examples of the format's documentation do what they say."""

import importlib.util
import json
import re
from pathlib import Path

import cv2
import numpy as np
import torch

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene

EXAMPLES = Path(__file__).resolve().parents[2] / "docs/examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def failed(scene):
    return [check for check in check_scene(scene) if check.verdict == "fail"]


def test_scene_of_ones_own_rig_passes_the_doctor_and_comes_into_the_store(tmp_path):
    path = example("own_rig").write(tmp_path / "out")
    assert path == tmp_path / "out/scenes/my-rig/drive-1"
    stored = ingest_scene("canonical", path.parent, "drive-1", tmp_path / "store")
    scene = DrivingScene.open(stored)
    assert failed(scene) == []
    assert len(scene.frame_indices) == 10
    assert scene.tracks[0].actor_id == "car-1"
    points = scene.read_points(0).xyz_m
    inside = (points[:, 1] > 3.0) & (points[:, 2] > 0.1)
    assert int(inside.sum()) == int(scene.tracks[0].num_points[0])


def test_example_stands_whole_in_the_description_of_the_format():
    page = (EXAMPLES.parent / "canonical-format.md").read_text()
    (shown,) = re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert shown == (EXAMPLES / "own_rig.py").read_text()


def test_nerfstudio_folder_becomes_a_scene_with_all_its_points(tmp_path):
    folder = tmp_path / "shop"
    folder.mkdir()
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 5, -3), (10, 15, 7), (100, 3))
    header = "ply\nformat ascii 1.0\nelement vertex 100\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (folder / "points.ply").write_text(
        header + "\n".join(" ".join(f"{x:.4f}" for x in row) for row in points)
    )
    frames = []
    for index in range(3):
        pose = np.eye(4)  # OpenGL: looks along world y from x right, z up
        pose[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        pose[:3, 3] = (1.0, 2.0 + index, 1.5)
        frames.append({"file_path": f"{index}.jpg", "transform_matrix": pose.tolist()})
        image = np.full((48, 64, 3), 90, np.uint8)
        cv2.imwrite(str(folder / f"{index}.jpg"), image)
    lens = {"fl_x": 50.0, "fl_y": 51.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    transforms = {**lens, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(transforms))
    path = example("nerfstudio").write(folder, tmp_path / "out", "CC0")
    scene = DrivingScene.open(ingest_scene("canonical", path.parent, "shop", tmp_path / "store"))
    found = np.concatenate([scene.read_points(frame).xyz_m for frame in scene.frame_indices])
    offset_m = scene.global_from_world[:3, 3].numpy()
    assert np.allclose(np.sort(found + offset_m, axis=0), np.sort(points, axis=0), atol=1e-3)
    forward = scene.views[0].camera.world_from_camera[:3, 2]
    assert torch.allclose(forward, torch.tensor([0.0, 1.0, 0.0]).double())
    assert torch.allclose(scene.world_from_ego[2, :3, 0], forward)
    assert torch.allclose(scene.world_from_ego[2, :3, 3], torch.tensor([0.0, 2.0, 0.0]).double())


def test_nerfstudio_lenses_may_differ_by_frame_and_fisheyes_keep_their_terms(tmp_path):
    folder = tmp_path / "rig"
    points = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    frames = []
    for index, camera in enumerate(("left", "right", "left", "right")):
        pose = np.eye(4)
        pose[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        pose[:3, 3] = (index % 2, 2.0 + index // 2, 1.5)
        file = f"images/{camera}/{index // 2:04d}.png"
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / file), np.full((48, 64, 3), 90, np.uint8))
        lens = {"fl_x": 30.0 + index % 2, "fl_y": 30.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
        frames.append({"file_path": file, "transform_matrix": pose.tolist(), **lens})
        # cameras of a rig are not triggered at the very same time
        frames[-1]["timestamp_ns"] = 1_000_000_000 + 100_000_000 * (index // 2) + index % 2
        if camera == "right":
            frames[-1] |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.01}
    (folder / "points.ply").write_text(points + "property float z\nend_header\n0 5 0\n1 6 0\n")
    transforms = {"camera_model": "OPENCV", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(transforms))
    path = example("nerfstudio").write(folder, tmp_path / "out", "CC0")
    scene = DrivingScene.open(ingest_scene("canonical", path.parent, "rig", tmp_path / "store"))
    assert [view.key for view in scene.views] == [
        (0, "left"),
        (0, "right"),
        (1, "left"),
        (1, "right"),
    ]
    assert scene.frame_timestamps_ns.tolist() == [1_000_000_000, 1_100_000_000]
    lenses = [scene.image_record(view) for view in scene.views[:2]]
    assert [lens.camera.fx_px for lens in lenses] == [30.0, 31.0]
    assert [lens.distortion.terms for lens in lenses] == [(), (0.05, 0.01, 0.0, 0.0)]
