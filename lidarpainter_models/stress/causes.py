"""What can go wrong with a recording, one cause at a time, at levels from mild to grave."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.stress import images, labels, sweeps
from lidarpainter_models.stress.frames import Frame

SHARES = (0.25, 0.5, 0.75, 1)


@dataclass(frozen=True, slots=True)
class Cause:
    """One thing that goes wrong."""

    name: str
    unit: str
    levels: tuple[float, ...]
    """Levels of the fault from mild to grave."""
    spoil: Callable[[Frame, float, np.random.Generator], Frame]
    """A frame at a level."""
    is_of_log: bool = False
    """Then it spoils all frames. What an actor is, its boxes say together; and a mount, a lens or a
    clock that is off in every second frame only would have views judged away from where the fit
    could learn that cameras are."""
    most_of: Callable[[int], int] | None = None
    """The gravest level that there is with so many cameras; None knows no end."""

    def levels_of(self, num_cameras: int) -> tuple[float, ...]:
        """The levels that a recording has; graver ones would spoil nothing more."""
        if self.most_of is None:
            return self.levels
        return tuple(level for level in self.levels if level <= self.most_of(num_cameras))


def _lost_pictures(frame: Frame, level: float, _dice: np.random.Generator) -> Frame:
    """Pictures of one in so many training frames are left."""
    return frame if frame.position // 2 % round(level) == 0 else replace(frame, images=())


CAUSES = {
    cause.name: cause
    for cause in (
        Cause("beams", "beams", (32, 16, 8, 4, 1, 0), sweeps.beams),
        Cause("reach", "m", (60, 40, 20, 10), sweeps.reach),
        Cause("dropout", "share", (0.25, 0.5, 0.75, 0.9), sweeps.dropout),
        Cause("clutter", "share", (0.02, 0.05, 0.1, 0.2), sweeps.clutter),
        Cause("clock", "ms", (10, 25, 50, 100), labels.clock_offset, is_of_log=True),
        Cause("pose-noise", "m", (0.02, 0.05, 0.1, 0.3), labels.pose_noise),
        Cause("camera-yaw", "degrees", (0.2, 0.5, 1, 2), labels.camera_yaw, is_of_log=True),
        Cause(
            "focal-length", "share", (0.005, 0.01, 0.02, 0.05), labels.focal_length, is_of_log=True
        ),
        Cause("box-noise", "m", (0.1, 0.25, 0.5, 1), labels.box_noise, is_of_log=True),
        Cause("missing-boxes", "share", SHARES, labels.missing_boxes, is_of_log=True),
        Cause("false-boxes", "boxes", (1, 2, 4, 8), labels.false_boxes, is_of_log=True),
        Cause("wrong-classes", "share", SHARES, labels.wrong_classes, is_of_log=True),
        Cause("exposure", "share", (0.1, 0.2, 0.3, 0.5), images.exposure),
        Cause("white-balance", "share", (0.05, 0.1, 0.2, 0.3), images.white_balance),
        Cause("motion-blur", "1/1000", (2, 5, 10, 20), images.motion_blur),
        Cause("darkness", "share", (0.5, 0.8, 0.9, 0.97), images.darkness),
        Cause("dirt", "share", (0.01, 0.03, 0.06, 0.12), images.dirt),
        Cause(
            "swapped", "pairs", (1, 2, 3, 4), images.swapped_cameras, most_of=lambda num: num // 2
        ),
        Cause(
            "missing-cameras",
            "cameras",
            (1, 2, 3, 4),
            images.missing_cameras,
            most_of=lambda num: num - 1,
        ),
        Cause("frame-rate", "one of", (2, 3, 4, 6), _lost_pictures),
    )
}


def cause_of(name: str) -> Cause:
    """A cause by name.

    Raises:
        ConfigError: there is none.
    """
    try:
        return CAUSES[name]
    except KeyError:
        raise ConfigError(f"no cause {name!r}, expected one of {', '.join(CAUSES)}") from None
