"""How a fitted scene is shown to whoever judges it: as it is, or painted at view time."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.evaluation.view_scores import Renderer
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.selection import PainterChoice


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewTimePainting:
    """Who paints what a scene shows, and what is known of each view."""

    conditions: ConditionBuilder
    painter: PainterChoice
    device: torch.device


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownScene:
    """A fitted scene and a way of looking at it."""

    scene: GaussianScene
    painting: ViewTimePainting | None = None
    """None shows the scene as it is."""

    def renderer(self, camera_name: str) -> Renderer:
        """What is seen in the colours of a camera."""
        painting = self.painting
        if painting is None:

            def render(camera: Camera, timestamp_ns: int) -> Float[Tensor, "height width 3"]:
                return self.scene.render(camera, timestamp_ns, camera_name=camera_name).rgb

            return render
        painter = painting.painter.load(painting.device)

        def paint(camera: Camera, timestamp_ns: int) -> Float[Tensor, "height width 3"]:
            conditions = painting.conditions.conditions(
                camera, timestamp_ns, camera_name=camera_name
            )
            return painter.paint(conditions).rgb

        return paint
