"""The panel of the live viewer: what can be chosen, and nothing of what it does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import viser

from lidarpainter_models.geometry.shifts import MAX_SHIFT_M

RECORDED, ASIDE, FREE = SEATS = ("recorded", "aside", "free")
SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x")
LOWEST_M = -1.0
"""The seat may be lowered so far."""
CLICK_HINT = "Click on an actor to see what it is."


@dataclass(frozen=True, kw_only=True)
class Controls:
    """Every control, to be read and written."""

    moment: viser.GuiSliderHandle[int]
    play: viser.GuiCheckboxHandle
    speed: viser.GuiDropdownHandle[str]
    seat: viser.GuiDropdownHandle[str]
    """Recorded and aside ride along; free stays in the world where it was."""
    left_m: viser.GuiSliderHandle[float]
    up_m: viser.GuiSliderHandle[float]
    straighten: viser.GuiButtonHandle
    scene: viser.GuiDropdownHandle[str]
    actors: viser.GuiCheckboxHandle
    boxes: viser.GuiCheckboxHandle
    tracks: viser.GuiCheckboxHandle
    cameras: viser.GuiCheckboxHandle
    lidar: viser.GuiCheckboxHandle
    picked: viser.GuiMarkdownHandle
    painted: viser.GuiCheckboxHandle
    render: viser.GuiButtonHandle
    own_image: viser.GuiImageHandle

    def on_change(self, shown: Callable[[], None]) -> None:
        """Call back whenever something changed that decides what is shown."""
        for control in (
            *(self.moment, self.seat, self.left_m, self.up_m, self.scene),
            *(self.actors, self.boxes, self.tracks, self.cameras, self.lidar),
        ):
            control.on_update(lambda _event: shown())


def add_controls(gui: viser.GuiApi, *, num_moments: int, scenes: Sequence[str]) -> Controls:
    """Put the panel together."""
    nothing = np.full((9, 16, 3), 255, np.uint8)
    time, seat, shown = (gui.add_folder(title) for title in ("Time", "Seat", "Shown"))
    own = gui.add_folder("The same view by our own renderer")
    with time:
        moment = gui.add_slider("moment", 0, max(num_moments - 1, 1), 1, 0)
        play = gui.add_checkbox("play", initial_value=False)
        speed = gui.add_dropdown("speed", SPEEDS, initial_value="1x")
    with seat:
        seats = gui.add_dropdown("seat", SEATS, initial_value=RECORDED)
        left_m = gui.add_slider("left, m", -MAX_SHIFT_M, MAX_SHIFT_M, 0.25, 2.0)
        up_m = gui.add_slider("up, m", LOWEST_M, MAX_SHIFT_M, 0.25, 0.0)
        straighten = gui.add_button("look straight ahead")
    with shown:
        scene = gui.add_dropdown("scene", tuple(scenes), initial_value=scenes[0])
        actors, boxes, tracks, cameras, lidar = (
            gui.add_checkbox(name, initial_value=name == "actors")
            for name in ("actors", "boxes", "tracks", "cameras", "LiDAR")
        )
        picked = gui.add_markdown(CLICK_HINT)
    with own:
        painted = gui.add_checkbox("painted", initial_value=False)
        render = gui.add_button("render")
        own_image = gui.add_image(nothing, visible=False)
    return Controls(
        moment=moment,
        play=play,
        speed=speed,
        seat=seats,
        left_m=left_m,
        up_m=up_m,
        straighten=straighten,
        scene=scene,
        actors=actors,
        boxes=boxes,
        tracks=tracks,
        cameras=cameras,
        lidar=lidar,
        picked=picked,
        painted=painted,
        render=render,
        own_image=own_image,
    )
