"""Boxes are picked and mended by click; what is shown, the file and the scene agree."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch
import viser
from tiny_street import tiny_street

from lidarpainter_models.editing.track_edits import Delete, Merge, Rename, TrackEdits
from lidarpainter_models.errors import ConfigError, WriteError
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


def press(button):
    """What a browser does to a button."""
    for callback in button._impl.update_cb:
        callback(Mock())


def edits_in_file(viewer):
    return TrackEdits.read(viewer.session.file, viewer.session.scene).edits


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
    press(viewer.controls.merge)
    assert second not in names_here(viewer)
    assert viewer.session.picked == [first]
    viewer.controls.name.value, viewer.controls.category.value = "one", "truck"
    press(viewer.controls.rename)
    told = {track.actor_id: track.category for track in viewer.session.tracks}
    assert told["one"] == "truck"
    assert viewer.session.picked == ["one"]
    press(viewer.controls.let_go)
    assert viewer.session.picked == []
    viewer.session.pick("one")
    press(viewer.controls.delete)
    assert not {first, second, "one"} & set(names_here(viewer))
    assert edits_in_file(viewer) == (
        Merge(actors=(first, second)),
        Rename(actor=first, name="one", category="truck"),
        Delete(actors=("one",)),
    )
    again = LabelSession(scene, viewer.session.file)
    assert [one.actor_id for one in again.tracks] == [one.actor_id for one in viewer.session.tracks]
    for _ in range(3):
        press(viewer.controls.undo)
    assert names_here(viewer)[:2] == [first, second]
    assert edits_in_file(viewer) == ()
    press(viewer.controls.undo)
    assert "no edit" in viewer.controls.told.value


def test_a_track_is_cut_at_the_frame_that_is_shown(viewer):
    viewer.controls.frame.value = 2
    name = next(
        track.actor_id
        for track, _ in viewer.session.present(viewer.frame_index)
        if int(track.frame_indices[0]) < viewer.frame_index
    )
    viewer.session.pick(name)
    press(viewer.controls.split)
    parts = {one.actor_id: one.frame_indices.tolist() for one in viewer.session.tracks}
    assert parts[name][-1] < viewer.frame_index == parts[f"{name}-2"][0]


def test_what_makes_no_sense_changes_nothing_and_says_why(viewer):
    name = names_here(viewer)[0]
    click_on(viewer, name)
    before = viewer.session.tracks
    press(viewer.controls.merge)
    assert "not done" in viewer.controls.told.value
    press(viewer.controls.let_go)
    for button in (viewer.controls.split, viewer.controls.delete, viewer.controls.rename):
        press(button)
        assert "nobody is picked" in viewer.controls.told.value
    assert viewer.session.tracks is before
    assert edits_in_file(viewer) == ()


def test_a_frame_without_a_sweep_shows_no_points(viewer, monkeypatch):
    assert viewer._lidar.cloud.visible
    monkeypatch.setattr(viewer.session.scene, "sweeps_of", lambda _: ())
    viewer.controls.frame.value = 1
    viewer.show()
    assert not viewer._lidar.cloud.visible


def test_a_click_means_the_frame_that_is_shown(viewer):
    shown = viewer.frame_index
    viewer.controls.frame.on_update(lambda _: None)
    viewer._turn = lambda: None  # the slider is ahead of what is drawn
    for callback in list(viewer.controls.frame._impl.update_cb):
        viewer.controls.frame.remove_update_callback(callback)
    viewer.controls.frame.value = 3
    assert viewer.frame_index == shown


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
    file.write_bytes(TrackEdits(scene="other/one", digest="0" * 64).file)
    with pytest.raises(ConfigError, match="holds edits of other/one"):
        LabelSession(scene, file)
    nobody = TrackEdits.begun(scene).with_edits([Delete(actors=("nobody",))])
    file.write_bytes(nobody.file)
    with pytest.raises(ConfigError, match="operation 1, delete"):
        LabelSession(scene, file)
    assert file.read_bytes() == nobody.file
    with pytest.raises(WriteError):
        LabelSession(scene, file / "in-a-file.json")
