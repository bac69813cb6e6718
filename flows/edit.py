"""Edit a finished run into a new one; a query like `render`, so no server is needed."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

from catalog.store import Store
from flows.derive import STYLE, Change, derive_run
from flows.parameters import view_parameters
from flows.views import render_run
from lidarpainter_models.devices import chosen_device
from lidarpainter_models.editing.apply import encounters, refuse_walls
from lidarpainter_models.editing.script import Drive, Operation, parse_operations
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.scenes.tracks import ActorTrack
from tasks.editing.donors import opened_world
from tasks.editing.edit import Edits, build_edited, build_observations
from tasks.runs import FinishedRun, lineage, open_run

EDIT = "edit"


def edit_run(
    store: Store,
    run: str,
    added: Sequence[Operation],
    *,
    painter: str | None = None,
    allows_collisions: bool = False,
) -> dict[str, Any]:
    """Make an edited run of a finished one.

    An edited run, styled since or not, is edited anew from where it came from, with both lists
    one after the other: what was uncovered is filled once, from what was recorded. Who paints what
    nobody saw is the run's own painter if None is named.

    Returns:
        As `derive_run`, with `trajectory`: where the script drives, `recorded` if it does not say.

    Raises:
        ConfigError: an operation cannot be done, or leads into a wall.
    """
    source, before = _origin(store, open_run(store, run))
    operations = (*before, *added)
    parameters = view_parameters(source)
    chosen = PainterChoice.of(painter or parameters.painter)
    edits = Edits(store=store, source=source, operations=operations)
    told = {
        "operations": [one.model_dump(exclude_defaults=True) for one in operations],
        "painter": chosen.name,
        "conditions": asdict(parameters.conditions),
        "allows_collisions": allows_collisions,
    }

    def check() -> None:
        found = encounters(edits.world)  # done once: it is kept for the builds
        if not allows_collisions:
            refuse_walls(found)

    result = derive_run(
        store,
        source,
        Change(kind=EDIT, parameters=told, inputs=edits.inputs | {"painter": chosen.digest}),
        build=partial(
            build_edited,
            edits=edits,
            conditions=parameters.conditions,
            painter=chosen,
            device=chosen_device(parameters.device),
        ),
        build_observations=partial(build_observations, edits=edits),
        check=check,
    )
    drives = [one.trajectory for one in operations if isinstance(one, Drive)]
    return {**result, "trajectory": drives[-1] if drives else "recorded"}


def shown_edit(
    store: Store,
    result: dict[str, Any],
    out: Path,
    *,
    painter: str | None = None,
    allows_collisions: bool = False,
) -> dict[str, Any]:
    """Images of an edited run where its script drives; painted by clear day."""
    shown = ViewRequest(
        trajectory=parse_trajectory(result["trajectory"]),
        is_painted=result["summary"]["style"] is None,  # painters know clear days
        painter=painter,
        allows_collisions=allows_collisions,
    )
    return render_run(store, result["run_id"], shown, out)


def list_actors(store: Store, run: str) -> list[dict[str, Any]]:
    """Everybody in a run: id, category, size, frames, Gaussians, distance when first seen."""
    world = opened_world(store, open_run(store, run))
    bodies = world.scene.gaussians.body_index.bincount(minlength=len(world.moving) + 1).tolist()
    rows = []
    for number, track in enumerate(world.tracks):
        is_moving = number < len(world.moving)
        length, width, height = (round(float(side), 1) for side in track.size_m)
        rows.append(
            {
                "actor_id": track.actor_id,
                "category": track.category,
                "is_moving": is_moving,
                "length_m": length,
                "width_m": width,
                "height_m": height,
                "frames": len(track.timestamps_ns),
                "num_gaussians": bodies[number + 1] if is_moving else len(world.rows_of(track)),
                "distance_m": _distance_m(world.log.ego.world_from_body, track),
            }
        )
    return sorted(rows, key=lambda row: row["distance_m"])


def _distance_m(world_from_ego: Any, track: ActorTrack) -> float:  # noqa: ANN401 - a tensor
    """From the ego's first place to the actor's first."""
    away = track.world_from_box[0, :3, 3] - world_from_ego[0, :3, 3]
    return round(float(away.norm()), 1)


def _origin(store: Store, run: FinishedRun) -> tuple[FinishedRun, Sequence[Operation]]:
    """The run that edits begin from, and what was done to it already, styles too."""
    chain = lineage(store, run)
    done = list(takewhile(lambda one: _kind(one) in (EDIT, STYLE), chain))
    edits = [number for number, one in enumerate(done) if _kind(one) == EDIT]
    first = min(edits[-1] + 1, len(chain) - 1) if edits else 0
    operations = [one for changed in reversed(chain[:first]) for one in _operations_of(changed)]
    return chain[first], operations


def _kind(run: FinishedRun) -> str | None:
    return None if run.change is None else run.change["kind"]


def _operations_of(run: FinishedRun) -> Sequence[Operation]:
    """How an edited or styled run was changed."""
    told: dict[str, Any] = {} if run.change is None else run.change["parameters"]
    if _kind(run) == EDIT:
        return parse_operations(told["operations"], f"the edits of run {run.run_id}")
    style = {"op": "style", "prompt": told["prompt"], "seed": told["seed"]}
    if "foggy" in told["prompt"]:
        style["visibility_m"] = told["visibility_m"]
    return parse_operations([style], f"the style of run {run.run_id}")
