"""Make a run whose scene lives in fog, at night or in rain, from one on a clear day."""

from functools import partial
from typing import Any

from catalog.store import Store
from flows.derive import Change, derive_run
from lidarpainter_models.weather.mix import StyleMix
from tasks.opened import open_scene
from tasks.reconstruction.style import put_style
from tasks.runs import open_run
from tasks.stored import load_observations, load_scene

STYLE = "style"
"""The kind of the change."""


def style_run(store: Store, run: str, mix: StyleMix, *, seed: int) -> dict[str, Any]:
    """Derive a run in a style, or recall the one that was; see `flows.derive`.

    The seed decides which windows are lit and where puddles stand.
    """
    source = open_run(store, run)
    recorded = open_scene(store, source.scene_id)
    told = {"prompt": mix.text, "visibility_m": mix.visibility_m, "seed": seed}
    return derive_run(
        store,
        source,
        Change(kind=STYLE, parameters=told, inputs={"scene": recorded.content_digest}),
        build=partial(
            put_style,
            scene=partial(load_scene, store, source.final.gaussians),
            observations=partial(load_observations, store, source.final.observations),
            recorded=partial(open_scene, store, source.scene_id),
            mix=mix,
            seed=seed,
        ),
    )
