"""The panel of the live viewer: what can be chosen, and nothing of what it does."""

from collections.abc import Callable, Sequence

import numpy as np
import viser

from lidarpainter_models.geometry.shifts import MAX_SHIFT_M

RECORDED, ASIDE, FREE = SEATS = ("recorded", "aside", "free")
"""Recorded and aside ride along; free stays in the world where it was."""
SPEEDS = ("0.25x", "0.5x", "1x", "2x", "4x")
LOWEST_M = -1.0
"""The seat may be lowered so far."""
CLICK_HINT = "Click on an actor to see what it is."


class Controls:
    """Every control, to be read and written."""

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
