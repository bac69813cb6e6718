"""Boxes of a scene over its sweeps and images, in a browser, and a person who mends them by click.

What is shown is the scene's tracks after the edits so far; every edit is written to a file at once.
Browser frame: that of the ego at the moment, x forward, y left, z up.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
import viser
from jaxtyping import UInt8
from pydantic import ValidationError

from lidarpainter_models.checks.overlay import PICKED_RGB, draw_boxes
from lidarpainter_models.editing.track_edits import (
    Delete,
    Merge,
    Rename,
    Split,
    TrackEdit,
    TrackEdits,
    edited_tracks,
)
from lidarpainter_models.errors import ConfigError, LidarPainterError
from lidarpainter_models.geometry.boxes import BOX_EDGES, box_corners, first_box_hit
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.observations.image_shrinking import shrink_image
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.storage.whole_files import storage_errors, write_whole
from lidarpainter_models.viewing.annotations import LINE_PX, LidarNodes, colour_of, plain
from lidarpainter_models.viewing.scene_nodes import node_name, place_node
from lidarpainter_models.viewing.servers import local_server

ROOT = "/recording"
PICKED = (PICKED_RGB[0] / 255, PICKED_RGB[1] / 255, PICKED_RGB[2] / 255)
SEAT_M = (-12.0, 0.0, 8.0)
"""Where a browser looks from at first: behind and above the car."""
LOOK_AT_M = (15.0, 0.0, 0.0)
IMAGE_PX = 960
"""Width of the image in the panel."""
HINT = "Click on boxes to pick them, on one again to let it go."


class LabelSession:
    """The tracks of a scene, what was changed about them, and who is picked."""

    def __init__(self, scene: DrivingScene, file: Path) -> None:
        """Go on where a file of edits ends; one that is not there is begun.

        Raises:
            ConfigError: it holds something else, or edits of another scene.
            WriteError: it cannot be written.
        """
        self.scene, self.file = scene, file
        self.picked: list[str] = []
        with storage_errors(file):
            is_there = file.exists()
        self._follow(TrackEdits.read(file, scene) if is_there else TrackEdits.begun(scene))

    def change(self, *edits: TrackEdit) -> None:
        """Append edits; the file and the tracks follow, or all stay as they were.

        Raises:
            ConfigError: an edit names nobody, or somebody twice.
            WriteError: the file cannot be written.
        """
        self._follow(self.made.with_edits([*self.made.edits, *edits]))
        self.picked += [edit.name for edit in edits if isinstance(edit, Rename) and edit.name]

    def undo(self) -> None:
        """Take the last edit back.

        Raises:
            ConfigError: there is none.
            WriteError: the file cannot be written.
        """
        if not self.made.edits:
            raise ConfigError("there is no edit to take back")
        self._follow(self.made.with_edits(self.made.edits[:-1]))

    def pick(self, name: str) -> None:
        """Pick an actor, or let it go."""
        if name in self.picked:
            self.picked.remove(name)
        else:
            self.picked.append(name)

    def let_go(self) -> None:
        """Pick nobody."""
        self.picked = []

    def present(self, frame_index: int) -> list[tuple[ActorTrack, torch.Tensor]]:
        """Who has a box in a frame, each with its `world_from_box` there."""
        rows = [(track, (track.frame_indices == frame_index).nonzero()) for track in self.tracks]
        return [(track, track.world_from_box[int(row[0])]) for track, row in rows if len(row)]

    def free_name(self, name: str) -> str:
        """A name like one that is taken, that nobody has."""
        taken = {track.actor_id for track in self.tracks}
        return next(
            other for number in range(2, 10**6) if (other := f"{name}-{number}") not in taken
        )

    def image(
        self, frame_index: int, camera_name: str
    ) -> UInt8[np.ndarray, "height width 3"] | None:
        """What a camera recorded in a frame, with the boxes where they are at the exposure.

        None where it took no image in that frame.
        """
        here = [one for one in self.scene.views_of(camera_name) if one.frame_index == frame_index]
        if not here:
            return None
        (view,) = here
        camera = view.camera.no_wider(IMAGE_PX)
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        image = shrink_image(self.scene.read_image(view), **size).numpy().copy()
        draw_boxes(image, camera, self.tracks, view.timestamp_ns, picked=self.picked)
        return image

    def _follow(self, made: TrackEdits) -> None:
        tracks = edited_tracks(self.scene.tracks, made.edits, str(self.file))
        write_whole(self.file, made.file)
        self.made, self.tracks = made, tracks
        known = {track.actor_id for track in tracks}
        self.picked = [name for name in self.picked if name in known]


class LabelControls:
    """The panel: the moment, who is picked, and what can be done with them."""

    def __init__(self, gui: viser.GuiApi, *, num_frames: int, cameras: Sequence[str]) -> None:
        """Put the panel together."""
        nothing = np.full((9, 16, 3), 255, np.uint8)
        self.frame = gui.add_slider("frame", 0, max(num_frames - 1, 1), 1, 0)
        self.camera = gui.add_dropdown("camera", tuple(cameras), initial_value=cameras[0])
        self.image = gui.add_image(nothing)
        self.picked = gui.add_markdown(HINT)
        with gui.add_folder("Those picked"):
            self.merge = gui.add_button("merge: they are one actor")
            self.split = gui.add_button("split: from this frame on it is another one")
            self.delete = gui.add_button("delete: nobody is there")
            self.name = gui.add_text("name", initial_value="")
            self.category = gui.add_text("class", initial_value="")
            self.rename = gui.add_button("rename")
            self.let_go = gui.add_button("let all go")
        self.undo = gui.add_button("undo the last edit")
        self.told = gui.add_text("", initial_value="", multiline=True, disabled=True)


class LabelViewer:
    """A session, its nodes and its panel.

    Callbacks come from viser's threads and wait for one another. A click means the frame that is
    shown, which the slider may have left already.
    """

    def __init__(self, server: viser.ViserServer, session: LabelSession) -> None:
        """Show the first frame, and answer the panel from now on."""
        scene = session.scene
        self._server, self.session, self._lock = server, session, threading.RLock()
        self._frames = [int(frame) for frame in scene.frame_indices]
        self._world = server.scene.add_frame(ROOT, show_axes=False)
        self._lidar = LidarNodes(server.scene, f"{ROOT}/lidar")
        self._boxes: viser.FrameHandle | None = None
        self._shown: tuple[int, str] | None = None
        server.initial_camera.position, server.initial_camera.look_at = SEAT_M, LOOK_AT_M
        server.gui.configure_theme(show_share_button=False, show_logo=False)
        cameras = list(dict.fromkeys(view.camera_name for view in scene.views))
        self.controls = controls = LabelControls(
            server.gui, num_frames=len(self._frames), cameras=cameras
        )
        controls.frame.on_update(lambda _: self._turn())
        controls.camera.on_update(lambda _: self._turn())
        controls.merge.on_click(lambda _: self._edit(lambda picked: [Merge(actors=tuple(picked))]))
        controls.split.on_click(lambda _: self._edit(self._splits))
        controls.delete.on_click(
            lambda _: self._edit(lambda picked: [Delete(actors=tuple(picked))])
        )
        controls.rename.on_click(lambda _: self._edit(self._renames))
        controls.undo.on_click(lambda _: self._try(session.undo))
        controls.let_go.on_click(lambda _: self._try(session.let_go))
        server.scene.on_click()(self._pick)
        self._try(lambda: None)

    @property
    def frame_index(self) -> int:
        """The frame that is shown."""
        return self._frames[0] if self._shown is None else self._shown[0]

    def show(self) -> None:
        """Show the frame that the panel says, with the boxes as they are now."""
        with self._lock, self._server.atomic():
            controls, scene = self.controls, self.session.scene
            frame = self._frames[min(controls.frame.value, len(self._frames) - 1)]
            if self._shown is None or self._shown[0] != frame:
                ego = scene.world_from_ego[scene.frame_position(frame)]
                place_node(self._world, invert_rigid(ego))
                self._lidar.cloud.visible = bool(scene.sweeps_of(frame))
                if self._lidar.cloud.visible:
                    self._lidar.place(scene.read_positions(frame), ego[:3, 3])
            self._shown = frame, controls.camera.value
            self._show_boxes(frame)
            image = self.session.image(*self._shown)
            controls.image.visible = image is not None
            if image is not None:
                controls.image.image = image
            controls.picked.content = self._words()

    def _turn(self) -> None:
        """Show what the slider and the camera say, once however often they were moved."""
        with self._lock:
            frame = self._frames[min(self.controls.frame.value, len(self._frames) - 1)]
            if (frame, self.controls.camera.value) != self._shown:
                self._try(lambda: None)

    def _show_boxes(self, frame_index: int) -> None:
        """A box and a name for everybody in a frame, in place of those of the frame before."""
        if self._boxes is not None:
            self._boxes.remove()
        self._boxes = self._server.scene.add_frame(f"{ROOT}/boxes", show_axes=False)
        numbers = {track.actor_id: number for number, track in enumerate(self.session.tracks)}
        for track, world_from_box in self.session.present(frame_index):
            number, is_picked = numbers[track.actor_id], track.actor_id in self.session.picked
            name = f"{ROOT}/boxes/{node_name(number, track)}"
            node = self._server.scene.add_line_segments(
                name,
                points=box_corners(track.size_m)[np.array(BOX_EDGES)].numpy(),
                colors=PICKED if is_picked else colour_of(number),
                thickness=(3 if is_picked else 1) * LINE_PX,
                thickness_units="screen",
            )
            place_node(node, world_from_box)
            above = (0.0, 0.0, float(track.size_m[2]) / 2)
            self._server.scene.add_label(f"{name}/name", plain(track.actor_id), position=above)

    def _pick(self, event: viser.SceneClickEvent) -> None:
        """Pick whose box a ray of the ego's frame meets first."""
        with self._lock:
            there = self.session.present(self.frame_index)
            if not there:
                return
            scene = self.session.scene
            ego = scene.world_from_ego[scene.frame_position(self.frame_index)].double()
            hit = first_box_hit(
                ego[:3, :3] @ torch.tensor(event.ray_origin).double() + ego[:3, 3],
                ego[:3, :3] @ torch.tensor(event.ray_direction).double(),
                torch.stack([pose for _, pose in there]),
                torch.stack([track.size_m for track, _ in there]),
            )
            if hit is not None:
                name = there[hit][0].actor_id
                self._try(lambda: self.session.pick(name))

    def _splits(self, picked: Sequence[str]) -> list[TrackEdit]:
        free_name, frame = self.session.free_name, self.frame_index
        return [Split(actor=name, frame=frame, name=free_name(name)) for name in picked]

    def _renames(self, picked: Sequence[str]) -> list[TrackEdit]:
        name, category = (
            control.value.strip() or None
            for control in (self.controls.name, self.controls.category)
        )
        return [Rename(actor=actor, name=name, category=category) for actor in picked]

    def _edit(self, edits_of: Callable[[Sequence[str]], Sequence[TrackEdit]]) -> None:
        """Change those picked."""

        def change() -> None:
            if not self.session.picked:
                raise ConfigError("nobody is picked: click on a box first")
            self.session.change(*edits_of(self.session.picked))

        self._try(change)

    def _try(self, act: Callable[[], None]) -> None:
        """Do something and show what came of it.

        Where it makes no sense the panel says why, and all stays as it was.
        """
        with self._lock:
            try:
                act()
                told = f"{len(self.session.made.edits)} edits in {self.session.file}"
                self.show()
            except LidarPainterError as error:
                told = f"not done: {error}"
            except ValidationError as error:
                told = f"not done: {error.errors()[0]['msg'].removeprefix('Value error, ')}"
            self.controls.told.value = told  # type: ignore[misc]  # it has a setter

    def _words(self) -> str:
        known = {track.actor_id: track for track in self.session.tracks}
        lines = [_in_words(known[name]) for name in self.session.picked]
        return "\n".join(f"- {line}" for line in lines) or HINT


def _in_words(track: ActorTrack) -> str:
    sides_m = " x ".join(f"{side:.1f}" for side in track.size_m.tolist())
    frames, moves = track.frame_indices.tolist(), "moves" if track.is_moving else "stands"
    return (
        f"**{plain(track.actor_id)}**, {plain(track.category)}, {sides_m} m, {moves}, frames "
        f"{frames[0]} to {frames[-1]} ({len(frames)} boxes)"
    )


@contextmanager
def label_viewer(session: LabelSession, *, port: int | None) -> Iterator[str]:
    """Show a session, for as long as the block runs; gives the address.

    Raises:
        ConfigError: the port is in use or not allowed.
    """
    label = f"{session.scene.dataset}/{session.scene.sequence}"
    with local_server(label=label, port=port) as server:
        LabelViewer(server, session)
        yield f"http://{server.get_host()}:{server.get_port()}"
