"""A finished run, taken along: what the stages write of it, and what they refuse."""

import json
import math
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.errors import ConfigError, SceneError, WriteError
from lidarpainter_models.export.formats import export_format
from lidarpainter_models.export.view_requests import ViewKinds, ViewRequest
from lidarpainter_models.gaussians.model.instance_images import SKY
from lidarpainter_models.gaussians.model.ply_files import read_ply
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from tasks.exports import scene as scene_export
from tasks.exports.dataset import export_dataset
from tasks.exports.scene import SceneRequest, export_images, export_scene, export_video
from tasks.exports.sweeps import export_sweeps
from tasks.stored import load_scene
from tasks.views.render import render


@pytest.fixture
def asked(store, run, parameters):
    """The run as tasks are given it, and its fit."""
    return parameters.run_spec(store.root), run.final


VIEW = ViewRequest(trajectory=parse_trajectory("lateral:1"), frames=slice(1, 3))
"""Two views a metre to the left."""
PLY = export_format("ply")


def load_lit(store, ref, *, gain):
    """The stored scene, its actors so much brighter in the second half of the log."""
    scene = load_scene(store, ref)
    log_gain = torch.zeros_like(scene.actors.light.log_gain)
    log_gain[len(log_gain) // 2 :] = math.log(gain)
    log_gain -= log_gain.mean(dim=0)
    light = replace(scene.actors.light, log_gain=log_gain)
    return replace(scene, actors=replace(scene.actors, light=light))


@pytest.mark.parametrize(
    ("wanted", "ending", "least_db"),
    [("ply", "ply", 80), ("spz", "spz", 40), ("gltf", "glb", 80), ("usd", "usdz", 80)],
)
def test_a_scene_is_written_and_says_what_is_lost(
    asked, tmp_path, monkeypatch, wanted, ending, least_db
):
    """Of actors that stay as bright nothing is lost but what the format rounds."""
    monkeypatch.setattr(scene_export, "load_scene", partial(load_lit, gain=1.0))
    out = tmp_path / "made" / f"street.{ending}"
    made = export_scene(*asked, export_format(wanted), SceneRequest(frame=2), out)
    assert made["path"] == str(out)
    assert made["num_bytes"] == out.stat().st_size
    assert made["num_actors"] == 1
    assert made["worst_psnr"] > least_db
    assert [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize(("wanted", "ending"), [("gltf", "glb"), ("usd", "usdz")])
def test_what_holds_many_moments_says_that_the_light_of_actors_is_lost(
    asked, tmp_path, monkeypatch, wanted, ending
):
    out = tmp_path / f"street.{ending}"
    monkeypatch.setattr(scene_export, "load_scene", partial(load_lit, gain=2.0))
    made = export_scene(*asked, export_format(wanted), SceneRequest(frame=2), out)
    assert made["worst_psnr"] < 50
    one_moment = export_scene(*asked, PLY, SceneRequest(frame=2), tmp_path / "street.ply")
    assert one_moment["worst_psnr"] > 80


def test_actors_stand_in_files_of_their_own(store, asked, tmp_path):
    export_scene(*asked, PLY, SceneRequest(is_per_actor=True), tmp_path / "parts")
    names = sorted(path.name for path in (tmp_path / "parts").iterdir())
    assert names == ["actor-000.ply", "street.ply"]
    scene = load_scene(store, asked[1].gaussians)
    counts = [len(read_ply(tmp_path / "parts" / name)) for name in names]
    assert counts == np.bincount(scene.gaussians.body_index.numpy())[::-1].tolist()
    comment = (tmp_path / "parts" / "actor-000.ply").read_bytes()[:300]
    assert b"box frame: x along the length, y left, z up" in comment


def test_chosen_actors_are_not_called_a_loss(asked, tmp_path):
    made = export_scene(*asked, PLY, SceneRequest(actors=()), tmp_path / "a.ply")
    assert (made["num_actors"], made["psnr"]) == (0, None)


@pytest.mark.parametrize(
    ("changes", "name", "error", "complaint"),
    [
        ({"actors": ("nobody",)}, "a.ply", SceneError, "has no actor 'nobody'"),
        ({"time_s": 99.0}, "a.ply", ConfigError, "--time 99: expected 0 to"),
        ({"frame": 99}, "a.ply", ConfigError, "--time frame:99: expected 0 to 3"),
        ({}, "a.obj", ConfigError, r"a\.obj: expected a name in \.ply"),
        ({"actors": (), "is_per_actor": True}, "a", SceneError, "leave --per-actor out"),
        ({}, "file/a.ply", WriteError, "cannot be written"),
        ({"is_per_actor": True}, "full", ConfigError, "is there already"),
    ],
)
def test_what_cannot_be_written_is_refused(asked, tmp_path, changes, name, error, complaint):
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept").touch()
    with pytest.raises(error, match=complaint):
        export_scene(*asked, PLY, SceneRequest(**changes), tmp_path / name)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "full", "kept"]


@pytest.mark.parametrize("wanted", ["colmap", "nerfstudio"])
def test_a_data_set_has_recorded_images_and_views_beside(viewed, tmp_path, wanted):
    made = export_dataset(viewed, VIEW, export_format(wanted), tmp_path / "set")
    assert (made["num_recorded"], made["num_images"]) == (2, 4)
    if wanted == "colmap":
        found = pycolmap.Reconstruction(tmp_path / "set" / "sparse" / "0")
        names = [image.name for image in found.images.values()]
        assert len(found.points3D) == made["num_points"] > 0
    else:
        frames = json.loads((tmp_path / "set" / "transforms.json").read_text())["frames"]
        names = [frame["file_path"].removeprefix("images/") for frame in frames]
    folders = sorted({name.split("/")[0] for name in names})
    assert folders == ["front", "front_lateral-1"]
    for name in names:
        assert cv2.imread(str(tmp_path / "set" / "images" / name)) is not None
    render_recorded = replace(VIEW, trajectory=parse_trajectory("recorded"), is_painted=True)
    with pytest.raises(ConfigError, match="recorded images are taken as they are"):
        export_dataset(viewed, render_recorded, export_format(wanted), tmp_path / "other")


def test_depth_and_semantics_say_the_same_of_the_sky(viewed, tmp_path):
    kinds = ViewKinds(images=False, depth=True, semantics=True)
    made = export_images(viewed, replace(VIEW, kinds=kinds), tmp_path / "maps")
    assert made["num_images"] == 2
    depth = cv2.imread(str(tmp_path / "maps" / "depth" / "0001.png"), cv2.IMREAD_UNCHANGED)
    who = cv2.imread(str(tmp_path / "maps" / "semantics" / "0001.png"), cv2.IMREAD_UNCHANGED)
    assert (depth.dtype, who.dtype) == (np.uint16, np.uint16)
    np.testing.assert_array_equal(depth == 0, who == SKY)
    legend = json.loads((tmp_path / "maps" / "semantics.json").read_text())
    assert {str(number) for number in np.unique(who)} <= set(legend["instances"])
    assert not (tmp_path / "maps" / "0001.png").exists()


def test_a_film_shows_the_recording_to_the_left(viewed, tmp_path):
    kinds = ViewKinds(images=False, video=True, fps=4.0)
    request = replace(VIEW, kinds=kinds, beside="recorded")
    made = export_video(viewed, request, tmp_path / "a.mp4")
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert (made["fps"], film.get(cv2.CAP_PROP_FRAME_COUNT)) == (4.0, 2)
    assert film.get(cv2.CAP_PROP_FRAME_WIDTH) == 240  # twice the width of the fit
    with pytest.raises(ConfigError, match=r"a\.avi: expected a name in \.mp4"):
        export_video(viewed, request, tmp_path / "a.avi")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize(("wanted", "ending"), [("lidar", ".pcd"), ("lidar-bin", ".pcd.bin")])
def test_recorded_sweeps_come_with_their_poses(asked, tmp_path, wanted, ending):
    made = export_sweeps(asked[0], export_format(wanted), slice(0, 2), tmp_path / "sweeps")
    listed = json.loads((tmp_path / "sweeps" / "sweeps.json").read_text())["sweeps"]
    assert (made["num_sweeps"], len(listed)) == (2, 2)
    assert all((tmp_path / "sweeps" / row["file"]).name.endswith(ending) for row in listed)
    with pytest.raises(SceneError, match="no LiDAR sweep is left"):
        export_sweeps(asked[0], export_format(wanted), slice(90, 99), tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_renders_come_with_film_depth_semantics_and_a_companion(viewed, tmp_path):
    kinds = ViewKinds(depth=True, semantics=True, video=True)
    with_other = replace(viewed, beside=viewed.fitted)
    made = render(with_other, replace(VIEW, kinds=kinds), tmp_path)
    assert made["fps"] == pytest.approx(10, abs=0.1)
    row = json.loads((tmp_path / "trajectory.json").read_text())["images"][0]
    for kind in ("file", "depth", "semantics", "beside"):
        assert (tmp_path / row[kind]).is_file()
    pair = cv2.imread(str(tmp_path / row["beside"]))
    np.testing.assert_array_equal(pair[:, :120], pair[:, 120:])  # the other run is this one
    assert (tmp_path / "video.mp4").is_file()
    with pytest.raises(ConfigError, match="--beside unpainted needs a painter"):
        replace(VIEW, beside="unpainted")


def test_images_say_how_far_they_can_be_trusted_and_films_do_not_ask(viewed, tmp_path, monkeypatch):
    asks = []
    gathered = EvidenceGatherer.of
    monkeypatch.setattr(
        EvidenceGatherer, "of", lambda *words, **named: asks.append(1) or gathered(*words, **named)
    )
    render(viewed, VIEW, tmp_path / "images")
    rows = json.loads((tmp_path / "images" / "trajectory.json").read_text())["images"]
    assert len(asks) == len(rows)
    assert all(0 <= row["confidence"] <= 1 for row in rows)
    film = replace(VIEW, kinds=ViewKinds(images=False, video=True))
    export_video(viewed, film, tmp_path / "drive.mp4")
    assert len(asks) == len(rows)
