"""A finished run in a browser: the panel moves what it says, and the page holds the drive."""

import socket
import threading
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock, patch

import pytest
import torch
import viser
from styled_world import styled
from viser import transforms
from websockets import Subprotocol
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.transforms import invert_rigid, quaternion_from_rotation
from lidarpainter_models.viewing import servers
from lidarpainter_models.viewing import watching as viewing_settings
from lidarpainter_models.viewing.annotations import vertical_fov_rad
from lidarpainter_models.viewing.drive_nodes import SEAT_FROM_CAMERA
from lidarpainter_models.viewing.servers import local_server
from lidarpainter_models.viewing.viewer import CLICK_HINT, LiveViewer
from lidarpainter_models.viewing.watching import Watch
from tasks.progress import ProgressListener, listening
from tasks.reconstruction.fit import fit
from tasks.stored import load_observations, load_scene
from tasks.views.drive import shown_drive, write_page

RECORDED = ViewRequest(trajectory=parse_trajectory("recorded"))


@pytest.fixture(scope="module")
def drive(run, viewed):
    scenes = {"painted": run.final, "before painting": run.unpainted}
    return shown_drive(viewed, RECORDED, scenes)


@pytest.fixture(scope="module")
def server():
    with local_server(port=0) as server:
        yield server


@pytest.fixture(scope="module")
def viewer(server, drive):
    return LiveViewer(server, drive)


@contextmanager
def chosen(viewer, **values):
    """The panel with other values, for as long as the block runs."""
    controls = {name: getattr(viewer.controls, name) for name in values}
    before = {name: control.value for name, control in controls.items()}
    for name, value in values.items():
        controls[name].value = value
    yield
    for name, value in before.items():
        controls[name].value = value


def pose(handle):
    """Parent from node."""
    rotation = transforms.SO3(handle.wxyz)
    found = transforms.SE3.from_rotation_and_translation(rotation, handle.position)
    return torch.from_numpy(found.as_matrix())


def seat_camera(server):
    """`world_from_camera` of the seat that the browser is shown."""
    world = server.scene.get_handle_by_name("/drive")
    return invert_rigid(pose(world)) @ SEAT_FROM_CAMERA


def from_the_seat(camera):
    """A browser's view straight ahead, as wide as the camera's."""
    view = Mock(viser.CameraHandle)
    view.wxyz = quaternion_from_rotation(SEAT_FROM_CAMERA[:3, :3]).numpy()
    view.position = torch.zeros(3).numpy()
    view.fov, view.aspect = vertical_fov_rad(camera), camera.width_px / camera.height_px
    return view


def shown(server, name):
    return server.scene.get_handle_by_name(f"/drive/{name}").visible


def test_seat_is_where_the_camera_stood(server, viewer, drive):
    for moment in range(len(drive.path.views)):
        with chosen(viewer, moment=moment):
            recorded = drive.path.camera(moment).world_from_camera
            assert torch.allclose(seat_camera(server), recorded, atol=1e-6)


def test_seat_aside_is_as_far_to_the_left_as_was_chosen(server, viewer, drive):
    with chosen(viewer, seat="aside", left_m=1.5, up_m=0.5):
        step = seat_camera(server) - drive.path.camera(0).world_from_camera
    assert torch.allclose(step[:3, 3], torch.tensor([0.0, 1.5, 0.5]).double(), atol=1e-6)
    assert float(step[:3, :3].abs().max()) < 1e-6


def test_free_seat_stays_while_actors_go_on(server, viewer, drive):
    car = server.scene.get_handle_by_name("/drive/painted/boxes/000 Car")
    with chosen(viewer, seat="aside"), chosen(viewer, seat="free"):
        before, stood = seat_camera(server), pose(car)
        with chosen(viewer, moment=3):
            assert torch.equal(seat_camera(server), before)
            expected = drive.path.builder.scene.actors.refined_poses(
                drive.path.views[3].timestamp_ns
            )
            assert torch.allclose(pose(car), expected[0][0], atol=1e-6)
            assert not torch.allclose(pose(car), stood, atol=0.1)


@pytest.mark.parametrize(
    ("control", "name"),
    [
        ("actors", "painted/actors"),
        ("boxes", "painted/boxes"),
        ("tracks", "painted/tracks"),
        ("cameras", "cameras"),
        ("lidar", "lidar"),
    ],
)
def test_every_tick_shows_and_hides_its_kind(server, viewer, control, name):
    for is_ticked in (True, False):
        with chosen(viewer, **{control: is_ticked}):
            assert shown(server, name) == is_ticked


def test_camera_shows_its_image_and_lidar_its_points(server, viewer, drive):
    with chosen(viewer, cameras=True, lidar=True, moment=2):
        frustum = server.scene.get_handle_by_name("/drive/cameras/front")
        assert frustum.image.std() > 10
        assert not frustum.visible  # one sits in it
        view = drive.path.views[2]
        cloud = server.scene.get_handle_by_name("/drive/lidar")
        assert len(cloud.points) == len(drive.path.recorded.read_points(view.frame_index).xyz_m)
        with chosen(viewer, seat="aside"):
            assert frustum.visible


def test_camera_without_an_image_at_the_moment_is_hidden(server, viewer, drive):
    recorded = drive.path.recorded
    last = drive.path.views[-1].frame_index
    others = [view for view in recorded.views if view.frame_index != last]
    with patch.object(recorded, "views", others), chosen(viewer, cameras=True, seat="aside"):
        assert shown(server, "cameras/front")
        with chosen(viewer, moment=len(drive.path.views) - 1):
            assert not shown(server, "cameras/front")


def test_scene_before_painting_takes_the_place_of_the_painted_one(server, viewer):
    with chosen(viewer, scene="before painting"):
        assert shown(server, "before painting")
        assert not shown(server, "painted")
    assert shown(server, "painted")
    assert not shown(server, "before painting")


def without_car(scene):
    street = (scene.gaussians.body_index == 0).nonzero()[:, 0]
    return replace(scene, gaussians=scene.gaussians.select(street), actors=scene.actors.without(1))


def test_boxes_and_clicks_are_those_of_the_scene_that_is_shown(drive):
    emptied = without_car(drive.path.builder.scene)
    scenes = {**drive.scenes, "edit": lambda: emptied}
    with local_server(port=0) as server:
        viewer = LiveViewer(server, replace(drive, scenes=scenes))
        with chosen(viewer, boxes=True, scene="edit"):
            assert shown(server, "edit/boxes")
            assert not shown(server, "painted")
            assert server.scene.get_handle_by_name("/drive/edit/boxes/000 Car") is None
            assert viewer._track_hit((0.0, 0.0, 0.0), (10.0, -4.0, -0.9)) is None
        assert viewer._track_hit((0.0, 0.0, 0.0), (10.0, -4.0, -0.9)).actor_id == "car"


def test_simulated_sweeps_are_of_the_scene_and_seat_that_are_shown(drive):
    asked = []

    def sweeps(scene, frame_index, aside_m):
        asked.append((scene, frame_index, aside_m))
        return torch.ones(7, 3)

    with local_server(port=0) as server:
        viewer = LiveViewer(server, replace(drive, sweeps=sweeps))
        cloud = server.scene.get_handle_by_name("/drive/lidar")
        with chosen(viewer, lidar=True):
            recorded = len(cloud.points)
            assert recorded > 7
            assert not asked
            with chosen(viewer, simulated=True, seat="aside", left_m=1.5):
                assert len(cloud.points) == 7
            assert len(cloud.points) == recorded
    scene, frame_index, aside_m = asked[-1]
    assert scene is viewer._nodes.shown.scene
    assert frame_index == drive.path.views[0].frame_index
    assert aside_m.norm().item() == pytest.approx(1.5, abs=1e-3)


def test_only_the_drives_own_scene_can_be_painted(drive):
    painting = Mock(ViewTimePainting)  # nobody paints
    foggy = styled("foggy", scene=drive.path.builder.scene)
    with local_server(port=0) as server:
        viewer = LiveViewer(server, drive, painting)
        assert not viewer.controls.painted.disabled
        with chosen(viewer, scene="before painting"):
            assert viewer.controls.painted.disabled
            view = from_the_seat(drive.path.camera(0))
            plain = viewer.own_image(view, painted=False)
            assert torch.equal(viewer.own_image(view, painted=True), plain)
    with local_server(port=0) as server:
        viewer = LiveViewer(server, replace(drive, scenes={"painted": lambda: foggy}), painting)
        assert viewer.controls.painted.disabled


def test_click_names_the_actor_under_it_and_nothing_else(viewer):
    car, sky = Mock(viser.SceneClickEvent), Mock(viser.SceneClickEvent)
    car.ray_origin = sky.ray_origin = (0.0, 0.0, 0.0)
    car.ray_direction, sky.ray_direction = (10.0, -4.0, -0.9), (0.0, 0.0, 1.0)
    viewer._pick(car)
    assert "**Car**, id `car`, 4.0 m long, 1.8 m wide, 1.5 m high" in viewer.controls.picked.content
    viewer._pick(sky)
    assert viewer.controls.picked.content == CLICK_HINT


def test_time_goes_on_while_playing_and_begins_again(viewer, drive):
    seen, stopped = [], threading.Event()

    def watch(event):
        seen.append(event.target.value)
        if len(seen) == len(drive.path.views):
            stopped.set()

    viewer.controls.moment.on_update(watch)
    with chosen(viewer, play=True, speed="4x"):
        viewer.play(stopped)
    viewer.controls.moment.remove_update_callback(watch)
    assert seen == [1, 2, 3, 0]


def test_own_image_is_what_the_scene_shows_from_the_browsers_camera(viewer, drive):
    camera = drive.path.camera(0)
    found = viewer.own_image(from_the_seat(camera), painted=False)
    scene, moment = drive.path.builder.scene, drive.path.views[0]
    expected = scene.render(camera, moment.timestamp_ns, camera_name="front").rgb.clamp(0, 1)
    lower = round(camera.height_px / 2 - camera.cy_px)  # a browser looks through the middle
    assert lower > 0
    error = (found[lower:] - expected[:-lower]).square().mean()
    assert float(error) < 1e-3


def test_port_that_is_taken_is_refused(server):
    with pytest.raises(ConfigError, match="cannot be had"), local_server(port=server.get_port()):
        pass


def connects(server, host, origin):
    """Whether a page of an origin may connect to the server by the name of a host."""
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    there = socket.create_connection(("127.0.0.1", server.get_port()))
    try:
        with connect(
            f"ws://{host}", sock=there, origin=origin, subprotocols=[protocol]
        ) as connection:
            return bool(connection.recv(timeout=10))
    except InvalidStatus:
        return False


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]"])
@pytest.mark.parametrize("port", ["", ":9000"])
def test_the_servers_own_page_may_connect_by_whatever_port_is_forwarded(server, name, port):
    assert connects(server, f"{name}{port}", f"http://{name}{port}")


def test_a_program_may_connect(server):
    assert connects(server, f"127.0.0.1:{server.get_port()}", None)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("127.0.0.1:8080", "https://elsewhere.example"),
        ("127.0.0.1:8080", "http://127.0.0.1:8081"),
        ("127.0.0.1:8080", "http://localhost:8080"),
        ("127.0.0.1:8080", "https://127.0.0.1:8080"),
        ("127.0.0.1:8080", "null"),
        ("elsewhere.example:8080", "http://elsewhere.example:8080"),  # a name that leads here
        ("elsewhere.example:8080", None),
        ("localhost.elsewhere.example", "http://localhost.elsewhere.example"),
    ],
)
def test_other_pages_may_not_connect(server, host, origin):
    assert not connects(server, host, origin)


def test_viser_that_would_let_other_pages_in_is_refused(monkeypatch):
    another = Mock(viser.ViserServer)  # it serves nothing by way of websockets
    monkeypatch.setattr(servers, "LocalServer", lambda *_, **__: another)
    with pytest.raises(ConfigError, match="lets other pages in"), local_server():
        pass
    another.stop.assert_called_once()


def test_page_drives_the_recorded_path_and_one_beside_it(viewed, tmp_path, capfd):
    out = tmp_path / "drive.html"
    made = write_page(viewed, RECORDED, out)
    page = out.read_text("utf-8")
    assert made["bytes"] == len(page) < 2_000_000
    assert "<title>LidarPainter: toy/street</title>" in page
    assert "made from numbers" in page
    assert capfd.readouterr().out == ""


def test_page_along_no_camera_is_refused(run, viewed):
    with pytest.raises(SceneError, match="no camera"):
        shown_drive(viewed, replace(RECORDED, camera="rear"), {"painted": run.final})


def test_a_running_fit_is_shown_and_stays_the_same(server, store, parameters, stages, monkeypatch):
    monkeypatch.setattr(viewing_settings, "EVERY_S", 0.0)
    monkeypatch.setattr(viewing_settings, "SHARE", 1.0)
    seen, config = stages["prepare"].ref, replace(parameters.fit, seed=7)
    listener = ProgressListener()
    listener.watch = Watch(server)
    with listening(listener):
        fitted = fit.fn(parameters.run_spec(store.root), "fit", seen, config)
    there = [name for name in range(1, 1000) if server.scene.get_handle_by_name(f"/fit/{name}")]
    assert len(there) == 1
    assert there[0] > 2
    assert torch.allclose(
        invert_rigid(pose(server.scene.get_handle_by_name("/fit"))) @ SEAT_FROM_CAMERA,
        load_observations(store, seen).views[0].camera.world_from_camera,
        atol=1e-5,
    )
    alone = fit_gaussians(load_observations(store, seen), config).scene
    watched = load_scene(store, fitted.ref)
    assert torch.equal(watched.gaussians.means, alone.gaussians.means)
    assert torch.equal(watched.gaussians.sh, alone.gaussians.sh)
