"""The order in which a fit looks at its views, and which it may look at at once.

Cameras of a frame that look apart show other Gaussians: the gradients of two of them, found at
once, are those of two steps one after the other. Of two frames they may look at one another.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import TrainingView


@dataclass(frozen=True, kw_only=True)
class ViewOrder:
    """Groups of views; those of a group show the same and count as one (see `seen_surface`)."""

    groups: tuple[tuple[int, ...], ...]
    """Positions of views."""
    apart: tuple[tuple[int, ...], ...]
    """Of each group, the groups of its frame that show nothing of what it shows."""

    @classmethod
    def of(cls, groups: tuple[tuple[int, ...], ...], views: Sequence[TrainingView]) -> "ViewOrder":
        """The order of these groups of the views."""
        firsts = [views[group[0]] for group in groups]
        of_frame: dict[int, list[int]] = {}
        for number, view in enumerate(firsts):
            of_frame.setdefault(view.key[0], []).append(number)
        return cls(
            groups=groups,
            apart=tuple(
                tuple(
                    other
                    for other in of_frame[view.key[0]]
                    if look_apart(view.camera, firsts[other].camera)
                )
                for view in firsts
            ),
        )

    def next_rows(
        self, waiting: list[int], generator: torch.Generator, *, at_most: int
    ) -> tuple[int, ...]:
        """The next view and, where two are allowed, one that looks apart and waits for its turn.

        `waiting` are groups still to be drawn from in this pass, in place; a pass has each group
        once, in random order.
        """
        if not waiting:
            waiting.extend(torch.randperm(len(self.groups), generator=generator).tolist())
        drawn = [waiting.pop()]
        if at_most > 1:
            drawn += [other for other in self.apart[drawn[0]] if other in waiting][:1]
        for other in drawn[1:]:
            waiting.remove(other)
        return tuple(self._one_of(self.groups[number], generator) for number in drawn)

    @staticmethod
    def _one_of(group: tuple[int, ...], generator: torch.Generator) -> int:
        if len(group) == 1:
            return group[0]
        return group[int(torch.randint(len(group), (), generator=generator))]


def look_apart(first: Camera, second: Camera) -> bool:
    """Whether the cones around what two cameras of a rig see have no direction in common."""
    axes = [camera.world_from_camera[:3, 2].double() for camera in (first, second)]
    between_rad = math.acos(max(-1.0, min(1.0, float(axes[0] @ axes[1]))))
    return between_rad > _half_angle_rad(first) + _half_angle_rad(second)


def _half_angle_rad(camera: Camera) -> float:
    """From the optical axis to the farthest corner."""
    across = max(camera.cx_px, camera.width_px - camera.cx_px) / camera.fx_px
    down = max(camera.cy_px, camera.height_px - camera.cy_px) / camera.fy_px
    return math.atan(math.hypot(across, down))
