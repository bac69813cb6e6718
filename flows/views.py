"""Show a finished run along a trajectory, as it is, painted or styled; queries without a server."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from catalog.store import Store
from flows.parameters import view_parameters
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.observations.fit_size import require_recorded_width
from lidarpainter_models.weather.mix import StyleMix
from tasks.opened import open_scene
from tasks.runs import FinishedRun, open_run
from tasks.specs import FittedRef
from tasks.views.files import ViewKinds
from tasks.views.render import RenderRequest, render
from tasks.views.stylize import Images, StylizeRequest, stylize


@dataclass(frozen=True, kw_only=True)
class PathRequest:
    """Which run is followed, and where."""

    run: str
    """A run id, a unique prefix of one, or `latest`."""
    trajectory: Trajectory
    camera: str | None = None
    frames: slice | None = None
    is_painted: bool = False
    """Whether a painter paints every image."""
    painter: str | None = None
    """Who; None takes the run's own."""
    allows_collisions: bool = False
    """Whether the camera may go through walls."""
    width_px: int | None = None
    """Of the images, at most as recorded; None takes that of the fit."""
    beside: str | None = None
    """What is shown to the left: `recorded`, `unpainted`, or another run of the same scene."""


def render_run(
    store: Store,
    path: PathRequest,
    out: Path,
    *,
    prompt: str,
    sequence: SequenceConfig,
    kinds: ViewKinds,
) -> dict[str, Any]:
    """Render a finished run where nobody drove."""
    finished = open_run(store, path.run)
    run = view_parameters(finished).run_spec(store.address, painter=path.painter)
    request = render_request(store, finished, path, kinds)
    request = replace(request, prompt=prompt, sequence=sequence)
    made = render.fn(run, finished.final, request, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "trajectory": path.trajectory.spec,
        "painter": run.painter if request.is_painted else None,
        "prompt": prompt,
        "previous": sequence.previous,
        **made,
    }


def render_request(
    store: Store, finished: FinishedRun, path: PathRequest, kinds: ViewKinds
) -> RenderRequest:
    """What the stage is asked for.

    Raises:
        ConfigError: images wider than recorded, or a run beside that shows another scene.
    """
    parameters = view_parameters(finished)
    observation = parameters.observation
    if path.width_px is not None:
        observation = replace(observation, width_px=path.width_px)
        views = open_scene(store, finished.scene_id).views
        require_recorded_width(path.width_px, views, "--width")
    return RenderRequest(
        trajectory=path.trajectory,
        camera=path.camera,
        frames=path.frames,
        is_painted=path.is_painted,
        observation=observation,
        conditions=parameters.conditions,
        allows_collisions=path.allows_collisions,
        kinds=kinds,
        beside=_beside(store, finished, path.beside),
    )


def _beside(
    store: Store, finished: FinishedRun, beside: str | None
) -> Literal["recorded", "unpainted"] | FittedRef | None:
    if beside is None:
        return None
    if beside == "recorded":
        return "recorded"
    if beside == "unpainted":
        return "unpainted"
    other = open_run(store, beside)
    if other.scene_id != finished.scene_id:
        raise ConfigError(
            f"--beside {beside}: shows {other.scene_id}, expected a run of {finished.scene_id}"
        )
    return other.final


def stylize_run(
    store: Store,
    path: PathRequest,
    out: Path,
    *,
    mix: StyleMix,
    images: Images,
    seed: int,
) -> dict[str, Any]:
    """Show a finished run in another weather or at night, and how well its edges are kept.

    The seed decides lit windows, drops and noise.

    Raises:
        ConfigError: images wider than recorded.
    """
    finished = open_run(store, path.run)
    view = render_request(store, finished, path, ViewKinds())
    request = StylizeRequest(mix=mix, view=view, images=images, seed=seed)
    run = view_parameters(finished).run_spec(store.address, painter=path.painter)
    made = stylize.fn(run, finished.final, request, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "prompt": mix.text,
        "trajectory": path.trajectory.spec,
        **made,
    }
