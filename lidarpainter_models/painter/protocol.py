"""What a painter is given and what it gives back.

All images of one request share the camera's pixel grid; rgb is float32 in [0, 1], depth is
camera z in metres with 0 where there is none.
"""

from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

DEFAULT_PROMPT = "clear"


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintingConditions:
    """Everything known about one view before it is painted."""

    render_rgb: Float[Tensor, "height width 3"]
    """The artefact-corrupted Gaussian render, sky included."""
    render_depth_m: Float[Tensor, "height width"]
    render_alpha: Float[Tensor, "height width"]
    """Opacity of the Gaussians alone, before the sky."""
    lidar_rgb: Float[Tensor, "height width 3"]
    """Coloured LiDAR points splatted into the view, 0 where none hits."""
    lidar_depth_m: Float[Tensor, "height width"]
    lidar_hit: Bool[Tensor, "height width"]
    warp_rgb: Float[Tensor, "sources height width 3"]
    """The nearest recorded training images carried here by depth, best first."""
    warp_valid: Bool[Tensor, "sources height width"]
    reference_rgb: Float[Tensor, "height width 3"] | None = None
    """The nearest recorded training image as it was taken, not carried into the view: the
    paper's reference. None where nobody gathered it."""
    prompt: str = DEFAULT_PROMPT

    @property
    def height_width_px(self) -> tuple[int, int]:
        """Rows and columns of every image."""
        return self.render_rgb.shape[0], self.render_rgb.shape[1]

    def cropped(self, rows: slice, columns: slice) -> "PaintingConditions":
        """What is known inside a rectangle."""
        images = {name: one for name, one in vars(self).items() if isinstance(one, Tensor)}
        cut: dict[str, Any] = {
            name: one[..., rows, columns, :] if name.endswith("rgb") else one[..., rows, columns]
            for name, one in images.items()
        }
        return replace(self, **cut)


@dataclass(frozen=True, kw_only=True, eq=False)
class Painting:
    """A repaired view and how far it can be trusted."""

    rgb: Float[Tensor, "height width 3"]
    confidence: Float[Tensor, "height width"]
    """In [0, 1]: 1 where the painter expects no error."""
    kept_share: float = 0.0
    """Of the image that was not painted because there was nothing to gain."""


@runtime_checkable
class Painter(Protocol):
    """Turns conditions into an image; deterministic, keeps no state between views."""

    name: str

    def paint(self, conditions: PaintingConditions) -> Painting:
        """Repair one view."""
