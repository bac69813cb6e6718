"""Judge a finished run again, or under another protocol; a query, so no server is needed."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from catalog.store import Store
from flows.overrides import with_changes
from flows.parameters import ViewParameters, view_parameters
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.score_tables import (
    FLICKER,
    Scores,
    fitted_on,
    flicker_by_image,
)
from tasks.evaluation.views import TRUTH, evaluate, evaluate_flicker, load_scores
from tasks.reconstruction.publish import record_scores
from tasks.runs import FinishedRun, open_run
from tasks.specs import FittedRef

VIEW_TIME = "view-time"


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """What is judged, and how."""

    run: str
    """A run id, a unique prefix of one, or `latest`."""
    protocol: str
    """`paper`, `truth`, `neurad`, `cross-camera`, `markings` or `flicker`."""
    is_painted: bool = False
    """Judge what is painted at view time as well."""
    painter: str | None = None
    """Who paints then; None takes the run's own. What another paints is judged, not entered."""
    changes: Mapping[str, Any]
    """Fields of the run's parameters that are replaced, such as weights of distances."""
    judges_all: bool = False
    """Judge every held-out view, not a sample of them."""
    previous: tuple[SequenceConfig, ...] = ()
    """For flicker: what else may become of the frame painted before."""


def evaluate_run(store: Store, request: EvaluationRequest) -> dict[str, Any]:
    """Judge a finished run on views it never saw, and enter its own scores into the catalog.

    Returns:
        `run_id`, `scene`, `protocol`, and the scores by variant (for flicker by shift):
        `unpainted` after the first fit; after the last round `painted`, or `refined` where the
        run had no painter; `view-time` if asked for.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
        ConfigError: the scene cannot be judged under this protocol.
    """
    finished = open_run(store, request.run)
    parameters = with_changes(view_parameters(finished), request.changes)
    if request.judges_all:
        scoring = replace(parameters.scoring, most_views=0)
        parameters = with_changes(parameters, {"scoring": scoring})
    about = {"run_id": finished.run_id, "scene": finished.scene_id, "protocol": request.protocol}
    if request.protocol == FLICKER:
        return about | _flicker(store, finished, parameters, request)
    scores = _variants(store, finished, parameters, request)
    own = {
        name: found
        for name, found in scores.items()
        if name != VIEW_TIME or _is_own_painter(request, parameters)
    }
    record_scores(store, finished.run_id, finished.scene_id, own)
    if request.protocol == TRUTH:
        scores = {name: _with_truth(found, finished.scene_id) for name, found in scores.items()}
    return about | scores


def _variants(
    store: Store, finished: FinishedRun, parameters: ViewParameters, request: EvaluationRequest
) -> dict[str, Scores]:
    judged: dict[str, FittedRef] = {}
    if finished.derived_from is None:
        judged["unpainted"] = finished.unpainted
    if finished.derived_from is not None or finished.final != finished.unpainted:
        judged[fitted_on(parameters.painter)] = finished.final
    if request.is_painted or request.painter:
        judged[VIEW_TIME] = finished.final
    run = parameters.run_spec(store.address, painter=request.painter)
    scores = {}
    for name, fitted in judged.items():
        made = evaluate.fn(
            run,
            f"{request.protocol}-{name}",
            fitted,
            parameters.evaluation_config,
            protocol=request.protocol,
            view_time=name == VIEW_TIME,
        )
        scores[name] = load_scores(store, made.ref)
    return scores


def _flicker(
    store: Store, finished: FinishedRun, parameters: ViewParameters, request: EvaluationRequest
) -> dict[str, Any]:
    run = parameters.run_spec(store.address, painter=request.painter)
    made = evaluate_flicker.fn(
        run, FLICKER, finished.final, parameters.evaluation_config, request.previous
    )
    found = load_scores(store, made.ref)[FLICKER]
    if _is_own_painter(request, parameters):
        record_scores(store, finished.run_id, finished.scene_id, flicker_by_image(found))
    return {"painter": run.painter, FLICKER: found}


def _is_own_painter(request: EvaluationRequest, parameters: ViewParameters) -> bool:
    """A number of the catalog does not say who painted: it is the run's own painter."""
    return request.painter in (None, parameters.painter)


def _with_truth(scores: Scores, scene_id: str) -> Scores:
    """Only views whose true image is known beside the path."""
    known = {name: found for name, found in scores["novel"].items() if found.get("psnr")}
    if not known:
        raise ConfigError(
            f"scene {scene_id} has no true images beside its path; only synthetic streets have"
        )
    return {"novel": known}
