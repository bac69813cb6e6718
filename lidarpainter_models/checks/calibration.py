"""Whether each camera looks where the scene says: depth edges of the LiDAR against image edges.

The points at depth edges (`checks.depth_edges`) are projected into the images of several frames,
turned by up to two degrees this way and that; the turn under which they lie best on image edges is
how far the camera's stated rotation is off (the idea of Levinson and Thrun, 2013, with a search in
place of their gradient). A turn about the optical axis (roll) is looked for after yaw and pitch, at
the best of these and at none (a roll can look like a small one of them), and judged where it stands
out: it moves the sides of an image alone. Where it does, yaw and pitch are looked for once more.

Edges alone lie: a guard rail beside a lane fits the next marking as well. So a camera fails only
where a second kind of evidence agrees (what the images of a moving car show of the same points);
where nothing else can tell, it is warned of, and where that disagrees, edges are not believed.

Camera frame: x right, y down, z forward. Yaw turns about y, pitch about x, roll about z.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lidarpainter_models.checks.depth_edges import EdgeImage, SceneEdges, edge_scores
from lidarpainter_models.checks.verdicts import Verdict

MAX_TURN_DEG = 0.6
"""A camera farther off is wrong.

Sound cameras of PandaSet 002 and of synthetic streets are found within 0.25 degrees, one step of
the search (one of twelve at 0.5 in roll); those a degree off in yaw or pitch at 0.75 at least. Of
twelve rolls of a degree planted in PandaSet 002 eleven are found, and the last one at 0.5.
"""
MIN_PEAK = 3.5
"""How many deviations the best turn must stand out from the turns around it to be believed.

With cameras of the same scenes turned by five degrees or more, where no turn can be right, the best
one stands out by 3.0 (median); where it is right, by 5.
"""
MIN_EDGE_POINTS, MIN_IMAGES = 500, 3
"""Fewer, over all frames, say nothing."""
_TURNS_DEG = np.arange(-2.0, 2.01, 0.25)
_ROLLS_DEG = np.arange(-3.0, 3.01, 0.25)
_PEAK_WIDTH_DEG, _ROLL_PEAK_WIDTH_DEG = 0.6, 0.8
"""Turns this near to the best one score well because of it."""
_MIN_PX_PER_DEG = 2.2
"""In coarser images blurred edges of a street move the best turn by a degree."""
_MIN_SIDE_PX = 64
"""Fewer pixels across, as in a cut-out, show too few edges to tell any turn from the others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTurn:
    """How far a camera's rotation is off."""

    yaw_deg: float
    pitch_deg: float
    peak: float
    """How many deviations yaw and pitch stand out."""
    roll_deg: float
    roll_peak: float
    """How many deviations the roll stands out."""

    @property
    def is_wrong(self) -> bool:
        """Whether a turn that stands out is larger than sound cameras show."""
        turned_deg = max(abs(self.yaw_deg), abs(self.pitch_deg))
        return (self.peak >= MIN_PEAK and turned_deg > MAX_TURN_DEG) or self.is_rolled

    @property
    def is_rolled(self) -> bool:
        """Whether a roll that stands out is larger than sound cameras show."""
        return self.roll_peak >= MIN_PEAK and abs(self.roll_deg) > MAX_TURN_DEG

    def __str__(self) -> str:
        yaw_pitch = f"yaw {self.yaw_deg:+.2f} pitch {self.pitch_deg:+.2f}"
        roll = f"roll {self.roll_deg:+.2f}"
        return f"{yaw_pitch} {_trust(self.peak)}, {roll} {_trust(self.roll_peak)}"


def _trust(peak: float) -> str:
    if peak >= MIN_PEAK:
        return "trusted"
    said = f"{peak:.2f} of {MIN_PEAK:.1f} deviations from other turns"
    return f"not trusted (stands out by {said})"


Agrees = Callable[[str, CameraTurn], bool | None]
"""Whether other evidence agrees that a camera is turned so; None where it cannot tell."""


def check_calibration(
    edges: SceneEdges, agrees: Agrees = lambda _name, _turn: None
) -> tuple[Verdict, str]:
    """Whether depth edges lie on image edges without turning any camera.

    Args:
        edges: of the scene.
        agrees: what else tells how a camera is turned, asked where edges call it turned.
    """
    scene = edges.scene
    said = {name: _said_of(edges, name, agrees) for name in scene.camera_names}
    detail = f"degrees off: {'; '.join(f'{name} {words}' for name, (_, words) in said.items())}"
    if wrong := [name for name, (state, _) in said.items() if state == "wrong"]:
        return "fail", f"{', '.join(wrong)} turned on its mount; {detail}"
    if alone := [name for name, (state, _) in said.items() if state == "alone"]:
        return "warn", f"{', '.join(alone)} turned, by edges alone: see the overlay; {detail}"
    if unsure := [name for name, (state, _) in said.items() if state == "unsure"]:
        return "warn", f"{', '.join(unsure)}: no turn within 2 degrees fits the edges; {detail}"
    return "ok", detail


def why_untold(edges: SceneEdges, name: str) -> str | None:
    """Why edges cannot tell how a camera looks, None if they can."""
    if name in edges.blank:
        return "its images show nothing"
    images = edges.images[name]
    # of the coarsest image that is looked at
    px_per_deg = min((image.camera.fx_px for image in images), default=0.0) * math.radians(1.0)
    if images and px_per_deg < _MIN_PX_PER_DEG:
        return f"images of {px_per_deg:.1f} pixels a degree, {_MIN_PX_PER_DEG} are needed"
    side_px = min((min(one.camera.width_px, one.camera.height_px) for one in images), default=0)
    if images and side_px < _MIN_SIDE_PX:
        return f"images {side_px} pixels across, {_MIN_SIDE_PX} are needed"
    num_points = sum(len(points) for image in images for points, _ in image.points.values())
    if num_points < MIN_EDGE_POINTS or len(images) < MIN_IMAGES:
        return f"fewer than {MIN_EDGE_POINTS} points at depth edges or {MIN_IMAGES} images"
    return None


def _said_of(edges: SceneEdges, name: str, agrees: Agrees) -> tuple[str, str]:
    """Whether a camera is wrong, unsure, sound or untold, and what its edges and images say."""
    if reason := why_untold(edges, name):
        return "untold", f"cannot be told ({reason})"
    turn = best_turn(edges.images[name])
    if not turn.is_wrong:
        return "unsure" if turn.peak < MIN_PEAK else "sound", str(turn)
    agreed = agrees(name, turn)
    if agreed is None:
        return "alone", f"{turn} (nothing else can tell)"
    if agreed:
        return "wrong", str(turn)
    return "sound", f"{turn} by edges alone: not believed, its images in motion do not agree"


def best_turn(images: Sequence[EdgeImage]) -> CameraTurn:
    """The turn of a camera that puts depth edges on image edges.

    A roll that stands out may have been taken for a pitch or yaw before it was known, so these are
    sought again with it.
    """
    turn = _turn_around(images, 0.0)
    if not turn.is_rolled:
        return turn
    again = _turn_around(images, turn.roll_deg)
    return again if again.is_rolled else turn


def _turn_around(images: Sequence[EdgeImage], roll_deg: float) -> CameraTurn:
    """The best yaw and pitch of a camera rolled by so much, then the best roll."""
    turns_deg = np.stack(np.meshgrid(_TURNS_DEG, _TURNS_DEG, roll_deg, indexing="ij"), axis=-1)
    plane = edge_scores(images, turns_deg.reshape(-1, 3)).reshape(turns_deg.shape[:2])
    row, column = np.unravel_index(plane.argmax(), plane.shape)
    yaw_deg, pitch_deg = _TURNS_DEG[column], _TURNS_DEG[row]
    line = max(_roll_scores(images, pitch_deg, yaw_deg), _roll_scores(images, 0, 0), key=max)
    best_roll_deg = _ROLLS_DEG[line.argmax()]
    apart = np.hypot(_TURNS_DEG[None] - yaw_deg, _TURNS_DEG[:, None] - pitch_deg)
    return CameraTurn(
        yaw_deg=float(yaw_deg),
        pitch_deg=float(pitch_deg),
        peak=_peak(plane, apart > _PEAK_WIDTH_DEG),
        roll_deg=float(best_roll_deg),
        roll_peak=_peak(line, np.abs(_ROLLS_DEG - best_roll_deg) > _ROLL_PEAK_WIDTH_DEG),
    )


def _roll_scores(images: Sequence[EdgeImage], pitch_deg: float, yaw_deg: float) -> np.ndarray:
    return edge_scores(images, np.array([(pitch_deg, yaw_deg, roll) for roll in _ROLLS_DEG]))


def _peak(scores: np.ndarray, is_apart: np.ndarray) -> float:
    """How many deviations the best score stands out from those of turns not near it."""
    others = scores[is_apart]
    return float((scores.max() - others.mean()) / max(float(others.std()), 1e-9))


MIN_LEAD = 0.08
"""By which another's images must fit better, in deviations of edge strength.

Of the cameras of PandaSet 002 own images lead by 0.17 to 0.66. Over the same images turned over or
mirrored those of PandaSet, KITTI, a night and streets lead by 0.08 to 0.71, where a degree has four
pixels or more; at 1.7 they lead by -0.1 to 0.1.
"""
_OVER = {"turned upside down": (-1, -1), "mirrored": (1, -1), "flipped": (-1, 1)}
"""Steps through the rows and the columns of an image."""


def check_image_places(edges: SceneEdges) -> tuple[Verdict, str]:
    """Whether the images of a camera are its own, and the right way up."""
    untold = {name: why for name in edges.images if (why := why_untold(edges, name)) is not None}
    over = [
        f"{name}'s look {way}"
        for name, images in edges.images.items()
        for way, steps in _OVER.items()
        if name not in untold
        and _lead(images, [_stepped(image, *steps) for image in images]) < -MIN_LEAD
    ]
    if over:
        return "fail", f"depth edges fit other images better: {', '.join(over)}"
    verdict, said = _check_swapped(edges)
    untried = [
        f"whether {name}'s are turned over was not checked ({untold[name]})" for name in untold
    ]
    return verdict, "; ".join([said, *untried])


def _stepped(image: EdgeImage, rows: int, columns: int) -> EdgeImage:
    turned = {
        kind: np.ascontiguousarray(strength[::rows, ::columns])
        for kind, strength in image.strengths.items()
    }
    return replace(image, strengths=turned)


def _check_swapped(edges: SceneEdges) -> tuple[Verdict, str]:
    """Whether the images of two cameras of one size fit each other's place better."""
    images = edges.images
    pairs = [
        (first, second)
        for first, second in combinations(images, 2)
        if _size(images[first]) == _size(images[second])
    ]
    if not pairs:
        return "ok", "no two cameras of one size"
    leads = {
        (first, second): (
            _lead(images[first], images[second]),
            _lead(images[second], images[first]),
        )
        for first, second in pairs
    }
    swapped = [" and ".join(pair) for pair, both in leads.items() if max(both) < -MIN_LEAD]
    if swapped:
        return "fail", f"the images of {', '.join(swapped)} look as if they had changed places"
    least = min(max(both) for both in leads.values())
    return "ok", f"of each two cameras' images one set fits its own place better, by {least:.2f}"


def _lead(own: Sequence[EdgeImage], other: Sequence[EdgeImage]) -> float:
    """How much better a camera's own images fit its depth edges than another's."""
    theirs = {image.frame_index: image.strengths for image in other}
    both = [image for image in own if image.frame_index in theirs]
    lent = [replace(image, strengths=theirs[image.frame_index]) for image in both]
    (own_score,), (lent_score,) = (edge_scores(images, np.zeros((1, 3))) for images in (both, lent))
    return float(own_score - lent_score)


def _size(images: Sequence[EdgeImage]) -> tuple[int, ...] | None:
    """Of images of which there are some."""
    return images[0].strengths["across"].shape if images else None
