"""The live viewer: a drive in a browser on this machine, with a panel that moves it.

Time goes in recorded moments. Callbacks come from viser's threads, so what is shown is changed
under one lock.
"""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
import viser
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.shown import ShownScene, ViewTimePainting
from lidarpainter_models.export.images import to_bytes
from lidarpainter_models.geometry.boxes import first_box_hit
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import MAX_SHIFT_M
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rigid_from_rotation,
    rotation_from_quaternion,
)
from lidarpainter_models.observations.image_shrinking import fit_camera, shrink_image
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.viewing.annotations import LidarNodes, RigNodes, plain
from lidarpainter_models.viewing.drive_nodes import (
    ROOT,
    DriveNodes,
    ShownDrive,
    look_forward,
    seat_from_world,
)
from lidarpainter_models.viewing.servers import local_server

FRUSTUM_PX = 240
"""Width of a recorded image in its frustum."""
PAUSED_S = 0.1
"""How often a standing viewer looks whether it is to play."""
RECORDED, ASIDE, FREE = SEATS = ("recorded", "aside", "free")
"""Recorded and aside ride along; free stays in the world where it was."""
SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x")
LOWEST_M = -1.0
"""The seat may be lowered so far."""
CLICK_HINT = "Click on an actor to see what it is."


class Controls:
    """The panel: every control, to be read and written."""

    def __init__(
        self, gui: viser.GuiApi, *, num_moments: int, scenes: Sequence[str], has_sweeps: bool
    ) -> None:
        """Put the panel together."""
        nothing = np.full((9, 16, 3), 255, np.uint8)
        time, seat, shown = (gui.add_folder(title) for title in ("Time", "Seat", "Shown"))
        own = gui.add_folder("The same view by our own renderer")
        with time:
            self.moment = gui.add_slider("moment", 0, max(num_moments - 1, 1), 1, 0)
            self.play = gui.add_checkbox("play", initial_value=False)
            self.speed = gui.add_dropdown("speed", SPEEDS, initial_value="1x")
        with seat:
            self.seat = gui.add_dropdown("seat", SEATS, initial_value=RECORDED)
            self.left_m = gui.add_slider("left, m", -MAX_SHIFT_M, MAX_SHIFT_M, 0.25, 2.0)
            self.up_m = gui.add_slider("up, m", LOWEST_M, MAX_SHIFT_M, 0.25, 0.0)
            self.straighten = gui.add_button("look straight ahead")
        with shown:
            self.scene = gui.add_dropdown("scene", tuple(scenes), initial_value=scenes[0])
            self.actors, self.boxes, self.tracks, self.cameras, self.lidar = (
                gui.add_checkbox(name, initial_value=name == "actors")
                for name in ("actors", "boxes", "tracks", "cameras", "LiDAR")
            )
            self.simulated = gui.add_checkbox(
                "LiDAR as simulated", initial_value=False, visible=has_sweeps
            )
            self.picked = gui.add_markdown(CLICK_HINT)
        with own:
            self.painted = gui.add_checkbox("painted", initial_value=False)
            self.render = gui.add_button("render")
            self.own_image = gui.add_image(nothing, visible=False)

    def on_change(self, shown: Callable[[], None]) -> None:
        """Call back whenever something changed that decides what is shown."""
        for control in (
            *(self.moment, self.seat, self.left_m, self.up_m, self.scene),
            *(self.actors, self.boxes, self.tracks, self.cameras, self.lidar, self.simulated),
        ):
            control.on_update(lambda _event: shown())


class LiveViewer:
    """A drive, its nodes and its panel."""

    def __init__(
        self, server: viser.ViserServer, drive: ShownDrive, painting: ViewTimePainting | None = None
    ) -> None:
        """Send the drive's first moment, and answer the panel from now on.

        `painting` is of the first scene; without it the own renderer's images are never painted.
        """
        self._server, self._drive, self._painting = server, drive, painting
        self._lock = threading.RLock()
        self._nodes = DriveNodes(server, drive)
        self._rig = RigNodes(server.scene, f"{ROOT}/cameras")
        self._lidar = LidarNodes(server.scene, f"{ROOT}/lidar")
        self._seat = drive.path.camera(0)
        server.gui.configure_theme(show_share_button=False, show_logo=False)
        self.controls = Controls(
            server.gui,
            num_moments=len(drive.path.views),
            scenes=list(drive.scenes),
            has_sweeps=drive.sweeps is not None,
        )
        self.controls.on_change(self.show)
        self.controls.straighten.on_click(lambda event: self._straighten(event.client))
        self.controls.render.on_click(lambda event: self._render(event.client))
        server.scene.on_click()(self._pick)
        self.show()

    def show(self) -> None:
        """Show what the panel says."""
        with self._lock, self._server.atomic():
            wanted = self.controls
            view = self._drive.path.views[self._moment]
            if wanted.seat.value != FREE:
                self._seat = self._camera_aside()
            self._nodes.show_scene(wanted.scene.value)
            wanted.painted.disabled = not self._is_paintable
            self._nodes.shown.actors.visible = wanted.actors.value
            self._nodes.tracks.boxes.visible = wanted.boxes.value
            self._nodes.tracks.tracks.visible = wanted.tracks.value
            self._nodes.place(view.timestamp_ns, self._seat)
            self._rig.root.visible = wanted.cameras.value
            if wanted.cameras.value:
                self._place_rig(view.frame_index)
            self._lidar.cloud.visible = wanted.lidar.value
            if wanted.lidar.value and self._drive.path.recorded.sweeps_of(view.frame_index):
                self._lidar.place(self._sweep(view.frame_index), self._seat.centre_world)

    def play(self, stopped: threading.Event) -> None:
        """Let time go on while `play` is ticked, and begin again after the last moment."""
        while not stopped.is_set():
            if not self.controls.play.value:
                stopped.wait(PAUSED_S)
                continue
            speed = float(self.controls.speed.value.rstrip("x"))
            views = self._drive.path.views
            after = (self._moment + 1) % len(views)
            pause_ns = max(views[after].timestamp_ns - views[self._moment].timestamp_ns, 0)
            stopped.wait(pause_ns * 1e-9 / speed)
            self.controls.moment.value = after  # type: ignore[misc]  # it has a setter

    def own_image(
        self, view: viser.CameraHandle, *, painted: bool
    ) -> Float[Tensor, "height width 3"]:
        """What our own renderer shows from where a browser looks."""
        with self._lock:
            camera = self._camera_of(view)
            moment = self._drive.path.views[self._moment]
            painting = self._painting if painted and self._is_paintable else None
            shown = ShownScene(scene=self._nodes.shown.scene, painting=painting)
            render = shown.renderer(self._drive.camera_name)
            return render(camera, moment.timestamp_ns).clamp(0, 1)

    @property
    def _is_paintable(self) -> bool:
        """What is known of views is of the drive's own scene, and painters know clear days."""
        is_own = self.controls.scene.value == next(iter(self._drive.scenes))
        return self._painting is not None and is_own and self._nodes.shown.scene.style is None

    @property
    def _moment(self) -> int:
        return min(self.controls.moment.value, len(self._drive.path.views) - 1)

    def _camera_aside(self) -> Camera:
        """The followed camera at the moment, moved as the panel says."""
        wanted, path = self.controls, self._drive.path
        if wanted.seat.value == ASIDE:
            spec = f"lateral:{wanted.left_m.value:g}+up:{wanted.up_m.value:g}"
            path = replace(path, trajectory=parse_trajectory(spec))
        return path.camera(self._moment)

    def _sweep(self, frame_index: int) -> Float[Tensor, "points 3"]:
        """What the LiDAR met, or would meet in the scene that is shown, from beside the path."""
        path, sweeps = self._drive.path, self._drive.sweeps
        if sweeps is None or not self.controls.simulated.value:
            return path.recorded.read_positions(frame_index)
        aside_m = self._camera_aside().centre_world - path.camera(self._moment).centre_world
        return sweeps(self._nodes.shown.scene, frame_index, aside_m)

    def _place_rig(self, frame_index: int) -> None:
        path, scene = self._drive.path, self._drive.path.builder.scene
        size = replace(path.observation, width_px=FRUSTUM_PX)
        in_the_way = self._drive.camera_name if self.controls.seat.value == RECORDED else None
        there = []
        for view in path.recorded.views:
            if view.frame_index != frame_index:
                continue
            camera = scene.refined_camera(view, fit_camera(view, size))
            rgb_u8 = shrink_image(
                path.recorded.read_image(view), width_px=camera.width_px, height_px=camera.height_px
            )
            self._rig.place(view.camera_name, camera, rgb_u8)
            if view.camera_name != in_the_way:
                there.append(view.camera_name)
        self._rig.show_only(there)

    def _camera_of(self, view: viser.CameraHandle) -> Camera:
        """Where a browser looks from, in the world, as wide as the images of the fit."""
        rotation = rotation_from_quaternion(torch.from_numpy(view.wxyz).double())
        seat_from_view = rigid_from_rotation(rotation, torch.from_numpy(view.position).double())
        width_px = self._seat.width_px
        height_px = max(round(width_px / view.aspect), 1)
        focal_px = height_px / 2 / math.tan(view.fov / 2)
        pose = self._world_from_seat @ seat_from_view
        return Camera.centred(pose, focal_px, width_px=width_px, height_px=height_px)

    @property
    def _world_from_seat(self) -> Float[Tensor, "4 4"]:
        return invert_rigid(seat_from_world(self._seat))

    def _straighten(self, client: viser.ClientHandle | None) -> None:
        """Sit down again, after having looked around."""
        for one in [client] if client else self._server.get_clients().values():
            look_forward(one.camera, self._drive.path.camera(0))

    def _render(self, client: viser.ClientHandle | None) -> None:
        if client is not None:
            rgb = self.own_image(client.camera, painted=self.controls.painted.value)
            self.controls.own_image.image = to_bytes(rgb)
            self.controls.own_image.visible = True

    def _pick(self, event: viser.SceneClickEvent) -> None:
        """Say what was clicked on."""
        with self._lock:
            track = self._track_hit(event.ray_origin, event.ray_direction)
            self.controls.picked.content = CLICK_HINT if track is None else _in_words(track)

    def _track_hit(
        self, origin_seat: Sequence[float], direction_seat: Sequence[float]
    ) -> ActorTrack | None:
        """The actor whose box a ray of the seat's frame meets first."""
        actors = self._nodes.shown.scene.actors
        moment = self._drive.path.views[self._moment]
        world_from_actors, present = actors.refined_poses(moment.timestamp_ns)
        there = [actors.recorded_tracks[row] for row in present.nonzero()[:, 0].tolist()]
        if not there:
            return None
        rotation, centre = self._world_from_seat[:3, :3], self._world_from_seat[:3, 3]
        hit = first_box_hit(
            rotation @ torch.tensor(origin_seat).double() + centre,
            rotation @ torch.tensor(direction_seat).double(),
            world_from_actors[present > 0],
            torch.stack([track.size_m for track in there]),
        )
        return None if hit is None else there[hit]


def _in_words(track: ActorTrack) -> str:
    length_m, width_m, height_m = track.size_m.tolist()
    return (
        f"**{plain(track.category)}**, id `{plain(track.actor_id)}`, {length_m:.1f} m long, "
        f"{width_m:.1f} m wide, {height_m:.1f} m high"
    )


@contextmanager
def live_viewer(
    drive: ShownDrive, painting: ViewTimePainting | None, *, label: str, port: int | None
) -> Iterator[tuple[LiveViewer, str]]:
    """A viewer and its address, for as long as the block runs.

    Raises:
        ConfigError: the port is in use or not allowed.
    """
    with local_server(label=label, port=port) as server:
        viewer = LiveViewer(server, drive, painting)
        yield viewer, f"http://{server.get_host()}:{server.get_port()}"
