"""Put a style into a finished scene."""

from collections.abc import Callable
from typing import Any

from catalog.artefacts import Workplace
from lidarpainter_models.conditioning.scene_styles import styled_scene
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene, describe
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.weather.mix import StyleMix
from tasks.progress import Progress
from tasks.stored import save_scene


def put_style(
    place: Workplace,
    progress: Progress,
    *,
    scene: Callable[[], GaussianScene],
    observations: Callable[[], SceneObservations],
    recorded: Callable[[], DrivingScene],
    mix: StyleMix,
    seed: int,
) -> dict[str, Any]:
    """The build of a styled scene; see `flows.derive`."""
    styled = styled_scene(
        scene(),
        observations(),
        recorded(),
        mix,
        seed=seed,
        progress=lambda done, total: progress(done, total, "looking for lamps"),
    )
    save_scene(place.output, styled, [])
    return describe(styled)
