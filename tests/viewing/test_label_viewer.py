"""Boxes are picked and mended by click; what is shown, the file and the scene agree."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch
import viser
from tiny_street import tiny_street

from lidarpainter_models.editing.track_edits import Delete, Merge, edited_tracks, read_track_edits
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import write_street
from lidarpainter_models.viewing.label_viewer import LabelSession, LabelViewer
from lidarpainter_models.viewing.servers import local_server


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return DrivingScene.open(write_street(tiny_street(12), tmp_path_factory.mktemp("labels")))


@pytest.fixture(scope="module")
def server():
    with local_server(port=0) as server:
        yield server


@pytest.fixture
def viewer(server, scene, tmp_path):
    server.scene.reset()
    server.gui.reset()
    return LabelViewer(server, LabelSession(scene, tmp_path / "edits.json"))


def click_on(viewer, name):
    """A click from high above the box of somebody, straight down."""
    scene, frame = viewer.session.scene, viewer.frame_index
    pose = next(p for track, p in viewer.session.present(frame) if track.actor_id == name)
    ego = scene.world_from_ego[scene.frame_position(frame)].double()
    centre = ego[:3, :3].T @ (pose[:3, 3].double() - ego[:3, 3])
    down = ego[:3, :3].T @ torch.tensor([0.0, 0.0, -1.0]).double()
    event = Mock(viser.SceneClickEvent)
    event.ray_origin = tuple((centre - 50 * down).tolist())
    event.ray_direction = tuple(down.tolist())
    viewer._pick(event)


def names_here(viewer):
    return [track.actor_id for track, _ in viewer.session.present(viewer.frame_index)]


def test_a_click_picks_whose_box_it_meets_and_another_lets_go(viewer):
    name = names_here(viewer)[0]
    click_on(viewer, name)
    assert viewer.session.picked == [name]
    assert name in viewer.controls.picked.content
    click_on(viewer, name)
    assert viewer.session.picked == []


def test_boxes_stand_where_the_tracks_have_them_in_the_frame_of_the_ego(viewer, server):
    viewer.controls.frame.value = 2
    viewer.show()
    shown = viewer.session.present(viewer.frame_index)
    numbers = {track.actor_id: n for n, track in enumerate(viewer.session.tracks)}
    for track, pose in shown:
        name = f"/recording/boxes/{numbers[track.actor_id]:03d} {track.category}"
        node = server.scene.get_handle_by_name(name)
        np.testing.assert_allclose(node.position, pose[:3, 3].numpy(), atol=1e-6)
    world = server.scene.get_handle_by_name("/recording")
    scene = viewer.session.scene
    ego = scene.world_from_ego[scene.frame_position(viewer.frame_index)]
    centre = -(ego[:3, :3].T @ ego[:3, 3])
    np.testing.assert_allclose(world.position, centre.numpy(), atol=1e-5)


def test_what_is_done_by_click_is_shown_and_written_and_undone(viewer, scene):
    first, second, *_ = names_here(viewer)
    for name in (first, second):
        click_on(viewer, name)
    viewer._edit(lambda picked: [Merge(actors=tuple(picked))])
    assert second not in names_here(viewer)
    assert viewer.session.picked == [first]
    assert read_track_edits(viewer.session.file) == (Merge(actors=(first, second)),)
    viewer.controls.name.value, viewer.controls.category.value = "", "truck"
    viewer._edit(viewer._renames)
    told = {track.actor_id: track.category for track in viewer.session.tracks}
    assert told[first] == "truck"
    again = LabelSession(scene, viewer.session.file)
    assert [one.actor_id for one in again.tracks] == [one.actor_id for one in viewer.session.tracks]
    for _ in range(3):
        viewer._try(viewer.session.undo)
    assert names_here(viewer)[:2] == [first, second]
    assert read_track_edits(viewer.session.file) == ()


def test_a_track_is_cut_at_the_frame_that_is_shown(viewer):
    viewer.controls.frame.value = 2
    name = next(
        track.actor_id
        for track, _ in viewer.session.present(viewer.frame_index)
        if int(track.frame_indices[0]) < viewer.frame_index
    )
    viewer.session.pick(name)
    viewer._edit(viewer._splits)
    parts = {one.actor_id: one.frame_indices.tolist() for one in viewer.session.tracks}
    assert parts[name][-1] < viewer.frame_index == parts[f"{name}-2"][0]


def test_what_makes_no_sense_changes_nothing_and_says_why(viewer):
    name = names_here(viewer)[0]
    click_on(viewer, name)
    before = viewer.session.tracks
    viewer._edit(lambda picked: [Merge(actors=tuple(picked))])
    assert "not done" in viewer.controls.told.content
    viewer._edit(lambda _: [Delete(actors=("nobody",))])
    assert "no actor" in viewer.controls.told.content
    assert viewer.session.tracks is before
    assert not viewer.session.file.exists()


def test_who_is_picked_is_drawn_otherwise_over_the_image(viewer, scene):
    view = scene.views[0]
    session, camera = viewer.session, view.camera
    ahead = {
        track.actor_id: camera.contains(*camera.project(pose[None, :3, 3].float())).any()
        for track, pose in session.present(view.frame_index)
    }
    plain = session.image(view.frame_index, view.camera_name)
    session.pick(next(name for name, is_seen in ahead.items() if is_seen))
    assert not np.array_equal(plain, session.image(view.frame_index, view.camera_name))


def test_edits_of_other_boxes_are_refused(scene, tmp_path):
    file = tmp_path / "edits.json"
    file.write_text('[{"op": "delete", "actors": ["nobody"]}]')
    with pytest.raises(ConfigError, match="edit 1"):
        LabelSession(scene, file)
    assert edited_tracks(scene.tracks, []) == list(scene.tracks)
