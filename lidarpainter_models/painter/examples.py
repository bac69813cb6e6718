"""What a painter learns from: conditions beside the true image, and where such pairs come from.

Painters know the shape of a pair and how to ask for one; `training_data` makes and stores
them.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.painter.protocol import PaintingConditions


class Window(NamedTuple):
    """A rectangle of pixels."""

    top_px: int
    left_px: int
    height_px: int
    width_px: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns."""
        return (
            slice(self.top_px, self.top_px + self.height_px),
            slice(self.left_px, self.left_px + self.width_px),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintingPair:
    """A damaged view with everything known about it, and what was really there."""

    conditions: PaintingConditions
    target_rgb: Float[Tensor, "height width 3"]
    target_valid: Bool[Tensor, "height width"]
    """Where the target may be learnt from."""

    def __post_init__(self) -> None:
        size = self.conditions.height_width_px
        if self.target_rgb.shape[:2] != size or self.target_valid.shape != size:
            raise ShapeError(
                f"a pair needs one pixel grid, got conditions {size} and target "
                f"{tuple(self.target_rgb.shape[:2])}"
            )

    def cropped(self, window: Window) -> "PaintingPair":
        """The pair inside a window."""
        rows, columns = window.slices
        conditions = self.conditions.cropped(rows, columns)
        return type(self)(
            conditions=conditions,
            target_rgb=self.target_rgb[rows, columns],
            target_valid=self.target_valid[rows, columns],
        )


@runtime_checkable
class PairSource(Protocol):
    """A set of pairs that gives windows of them; reading has no side effect."""

    def __len__(self) -> int:
        """Number of pairs."""

    @property
    def digest(self) -> str:
        """Says exactly which pairs these are."""

    def size_px(self, index: int) -> tuple[int, int]:
        """Height and width of a pair."""

    def read(self, index: int, window: Window | None = None) -> PaintingPair:
        """A pair, or the part of it inside a window."""

    def describe(self) -> dict[str, Any]:
        """Where the pairs come from, as JSON types."""
