"""Held-out views of a fitted scene as pairs: what a painter would be shown, and the truth.

Recorded logs judge at the held-out frames, synthetic streets beside the path, where they know the
exact image.
"""

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import torch

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.evaluation.held_back import target_view
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_scores import ScoredView
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.painter.examples import PaintingPair
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.synthetic.street import SyntheticStreet

RECORDED = "recorded"
"""Name of the held-out frames at interpolated poses."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutPairs:
    """The held-out views of one trajectory; conditions are gathered when a pair is read."""

    builder: ConditionBuilder
    """With the scene whose render is painted."""
    held_out: HeldOut
    beside: tuple[SyntheticStreet, Shift] | None = None
    """The world and where in it; None for the recorded images."""

    def __len__(self) -> int:
        return len(self.held_out.test_views)

    def read(self, index: int) -> PaintingPair:
        """The pair of a held-out view; its target is known but for the recording car."""
        view = self.held_out.test_views[index]
        judged = self._judged(view)
        conditions = self.builder.conditions(
            judged.camera, judged.timestamp_ns, camera_name=view.camera_name
        )
        truth = judged.truth_rgb.clamp(0, 1)
        everywhere = torch.ones(truth.shape[:2], dtype=torch.bool)
        known = everywhere if judged.hidden is None else ~judged.hidden
        return PaintingPair(conditions=conditions, target_rgb=truth, target_valid=known)

    def _judged(self, view: RecordedView) -> ScoredView:
        alone, fitted = replace(self.held_out, test_views=[view]), self.builder.scene
        if self.beside is None:
            return alone.recorded_views(fitted, "interpolated")[0]
        street, shift = self.beside
        return alone.synthetic_views(fitted, street, shift)[0]


def held_out_pairs(
    builder: ConditionBuilder,
    held_out: HeldOut,
    street: SyntheticStreet | None,
    shifts: Sequence[Shift],
) -> dict[str, HeldOutPairs]:
    """The pairs of a scene by trajectory: at the shifts of a street, else as recorded."""
    if street is None:
        return {RECORDED: HeldOutPairs(builder=builder, held_out=held_out)}
    return {
        shift.name: HeldOutPairs(builder=builder, held_out=held_out, beside=(street, shift))
        for shift in shifts
    }


def unseen_views(
    views: Sequence[RecordedView], scene_id: str, trained: AbstractSet[str]
) -> list[RecordedView]:
    """The views of a scene of which no painter was trained on an image, from whatever place.

    `trained` holds targets that painters were trained on (`held_back.target_of`).
    """
    known = {target_view(target) for target in trained}
    return [view for view in views if (scene_id, view.frame_index, view.camera_name) not in known]
