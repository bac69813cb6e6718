"""Publish what a finished run yields into the library of assets; needs no server."""

from typing import Any

from catalog.store import Store
from flows.derive import STYLE
from flows.edit import EDIT
from flows.parameters import view_parameters
from lidarpainter_models.errors import ConfigError
from tasks.assets.enter import enter_published
from tasks.assets.fuse import fuse_sightings
from tasks.assets.publish import publish_assets
from tasks.editing.donors import PARKED
from tasks.runs import FinishedRun, lineage, open_run


def publish_run(store: Store, run: str) -> dict[str, Any]:
    """Publish the street, the actors, the sky and the trajectories of a run.

    Vehicles that other sequences show too are fused from all of their sightings.
    The same run again changes nothing.

    Returns:
        What `--json` prints.

    Raises:
        ConfigError: the run was edited: what it shows is not what was recorded.
    """
    finished = open_run(store, run)
    if (kind := _other_change(store, finished)) is not None:
        first = lineage(store, finished)[-1]
        raise ConfigError(
            f"run {finished.run_id} was changed ({kind}), "
            f"expected a recorded or styled one: publish {first.derived_from or first.run_id}"
        )
    style = None if finished.change is None else finished.change["parameters"]["prompt"]
    parameters = view_parameters(finished)
    published = publish_assets(parameters.run_spec(store.address), finished, parameters.observation)
    ids = enter_published(store, finished, published, style)
    fused = fuse_sightings(store, set(ids))
    counts = {name: count for name, count in published.summary.items() if name.startswith("num_")}
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "style": style,
        **counts,
        "num_assets": len(set(ids)),
        "num_fused": len(fused),
        "assets": ids,
        "artefact": str(store.artefacts.folder(published.ref)),
        "seconds": published.seconds,
        "cpu_seconds": published.cpu_seconds,
        "is_new": published.is_new,
    }


def _other_change(store: Store, finished: FinishedRun) -> str | None:
    """What else than styles a run went through; edits show in what may be seen of it."""
    kinds = [one.change["kind"] for one in lineage(store, finished) if one.change is not None]
    if store.artefacts.manifest(finished.final.observations).summary.get(PARKED) is not None:
        kinds.append(EDIT)
    return next((kind for kind in kinds if kind != STYLE), None)
