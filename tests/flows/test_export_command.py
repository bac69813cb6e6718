"""`export`, the views of `render`, and `view`, on the tiny street with two cameras."""

import json
from pathlib import Path

import cv2
import pytest
import torch
from commands import seen_image, succeed
from plyfile import PlyData
from tiny_street import FRONT, HEIGHT_PX, NUM_FRAMES, SCENE, SIDE, WIDTH_PX

from flows import interruption
from lidarpainter_models.geometry.transforms import invert_rigid
from tasks.opened import open_scene


def test_a_scene_is_exported_with_what_it_loses(tiny_run, tmp_path):
    words = (
        "export",
        tiny_run.run_id,
        "--format",
        "ply",
        "--out",
        tmp_path / "a.ply",
        "--time",
        "0.1",
    )
    made = succeed(*words, "--json", store=tiny_run.store).json
    assert (made["run_id"], made["scene"]) == (tiny_run.run_id, SCENE)
    assert made["path"] == str(tmp_path / "a.ply")
    assert made["num_gaussians"] == len(PlyData.read(made["path"])["vertex"])
    assert made["psnr"] > 60
    told = succeed(*words, "--sky", store=tiny_run.store)
    assert "far Gaussians" in told.out


@pytest.mark.parametrize("wanted", ["colmap", "semantics", "video"])
def test_every_camera_is_exported_also_one_that_no_fit_used(tiny_run, tmp_path, wanted):
    words = ("--format", wanted, "--out", tmp_path / "a", "--camera", "all", "--frames", "0:2")
    made = succeed("export", tiny_run.run_id, *words, "--json", store=tiny_run.store).json
    assert made["num_images"] == 4
    found = {path.name.split(".")[0] for path in Path(made["path"]).rglob("*")}
    assert {FRONT, SIDE} <= found


def test_render_shows_all_cameras_wider_and_beside_the_recording(tiny_run, tmp_path):
    words = ("--trajectory", "lateral:0.5", "--camera", "all", "--frames", "0:2", "--fps", "5")
    words += ("--width", WIDTH_PX // 2, "--video", "--beside", "recorded", "--out", tmp_path)
    made = succeed("render", tiny_run.run_id, *words, "--json", store=tiny_run.store).json
    assert made["cameras"] == f"{FRONT}, {SIDE}"
    for camera in (FRONT, SIDE):
        seen_image(tmp_path / camera / "0001.png", WIDTH_PX // 2, HEIGHT_PX // 2)
        seen_image(tmp_path / camera / "beside" / "0001.png", WIDTH_PX, HEIGHT_PX // 2)
        film = cv2.VideoCapture(str(tmp_path / camera / "video.mp4"))
        assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(5)
    assert made["video"].split(", ")[0] == str(tmp_path / "video.mp4")
    together = (WIDTH_PX, HEIGHT_PX // 2 * 2, 2)  # two cameras in a row, the recording above
    assert film_size(tmp_path / "video.mp4") == together


def film_size(path):
    film = cv2.VideoCapture(str(path))
    kinds = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT)
    return tuple(int(film.get(kind)) for kind in kinds)


def test_one_film_shows_all_cameras(tiny_run, tmp_path):
    words = ("--format", "video", "--camera", "all", "--frames", "0:2", "--json")
    out = tmp_path / "drive.mp4"
    made = succeed("export", tiny_run.run_id, *words, "--out", out, store=tiny_run.store).json
    assert (made["path"], made["num_images"], made["fps"]) == (str(out), 4, pytest.approx(10))
    assert film_size(out) == (2 * WIDTH_PX, HEIGHT_PX, 2)
    assert list(tmp_path.iterdir()) == [out]


def test_a_camera_that_no_fit_used_rides_on_the_rig_as_the_fit_found_it(tiny_run, tmp_path):
    words = ("--trajectory", "recorded", "--camera", "all", "--frames", "1:2", "--out", tmp_path)
    succeed("render", tiny_run.run_id, *words, store=tiny_run.store)
    found = {}
    for camera in (FRONT, SIDE):
        (row,) = json.loads((tmp_path / camera / "trajectory.json").read_text())["images"]
        found[camera] = torch.tensor(row["world_from_camera"], dtype=torch.float64).reshape(4, 4)
    logged = {
        view.camera_name: view.camera.world_from_camera
        for view in open_scene(tiny_run.store, SCENE).views
        if view.frame_index == 1
    }
    front_from_side = invert_rigid(found[FRONT]) @ found[SIDE]
    expected = invert_rigid(logged[FRONT]) @ logged[SIDE]
    torch.testing.assert_close(front_from_side, expected, atol=1e-9, rtol=0)
    assert not torch.allclose(found[SIDE], logged[SIDE], atol=1e-6)


def test_frames_are_numbered_as_recorded(tiny_run, tmp_path):
    words = ("--format", "lidar-bin", "--out", tmp_path / "a", "--frames", f"{NUM_FRAMES - 1}:")
    made = succeed("export", tiny_run.run_id, *words, "--json", store=tiny_run.store).json
    (file,) = Path(made["path"]).rglob("*.pcd.bin")
    assert file.name == f"{NUM_FRAMES - 1:04d}.pcd.bin"


def test_page_is_one_file_that_names_the_scene(tiny_run, tmp_path):
    out = tmp_path / "drive.html"
    answer = succeed(
        "export", "latest", "--format", "page", "--out", out, "--json", store=tiny_run.store
    )
    page = out.read_text("utf-8")
    assert answer.json["path"] == str(out)
    assert answer.json["bytes"] == len(page) < 3_000_000
    assert f"<title>LidarPainter: {tiny_run.result['scene']}</title>" in page


def test_view_says_where_it_is_and_opens_a_browser_there(tiny_run, monkeypatch):
    from lidarpainter_models.viewing.viewer import LiveViewer

    visited = []
    monkeypatch.setattr(LiveViewer, "play", lambda *_: None)  # else it plays until Ctrl-C
    monkeypatch.setattr("webbrowser.open", visited.append)
    answer = succeed("view", "latest", store=tiny_run.store)
    assert answer.out.startswith("http://127.0.0.1:")
    assert answer.out.splitlines() == visited
    assert interruption.message() == "closed"  # what Ctrl-C says from then on
