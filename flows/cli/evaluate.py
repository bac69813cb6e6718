"""`lidarpainter evaluate`: judge a finished run again, or under another protocol."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.output import print_json, print_table
from flows.cli.shared_options import AsJson, RunName
from lidarpainter_models.errors import ConfigError

PROTOCOLS = ("paper", "truth", "cross-camera", "flicker")
FLICKER = "flicker"


def evaluate(  # noqa: PLR0913 - the options of a command
    run: RunName,
    protocol: Annotated[str, typer.Option(help=f"{', '.join(PROTOCOLS)}.")] = "paper",
    postpaint: Annotated[
        bool, typer.Option("--postpaint", help="Judge what is painted at view time as well.")
    ] = False,
    painter: Annotated[
        str | None, typer.Option(help="Painter for --postpaint; the run's own if absent.")
    ] = None,
    feature_weights: Annotated[
        Path | None, typer.Option(help="SqueezeNet 1.1 weights for the feature distance.")
    ] = None,
    lpips_backbone: Annotated[
        Path | None, typer.Option(help="torchvision's VGG-16, AlexNet or SqueezeNet, for LPIPS.")
    ] = None,
    lpips_heads: Annotated[
        Path | None, typer.Option(help="LPIPS heads (version 0.1) of the same network.")
    ] = None,
    previous: Annotated[
        str | None,
        typer.Option(help="For flicker: also lean on the frame before, mixed or shown (or both)."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Judge a finished run on views it never saw."""
    _check(protocol, previous)
    from catalog.store import open_store
    from flows.cli.flicker import show_flicker
    from flows.cli.progress import shown_progress
    from flows.overrides import with_changes
    from flows.parameters import view_parameters
    from tasks.evaluation.cross_camera import evaluate_strips
    from tasks.evaluation.scene import evaluate as evaluate_task
    from tasks.evaluation.scores import load_scores
    from tasks.reconstruction.publish import record_scores
    from tasks.runs import open_run

    store = open_store()
    finished = open_run(store, run)
    parameters = view_parameters(finished)
    parameters = with_changes(parameters, _weights(feature_weights, lpips_backbone, lpips_heads))
    if protocol == FLICKER:
        show_flicker(store, finished, parameters, painter, previous, as_json=as_json)
        return
    variants: dict[str, tuple[Any, str | None]] = {
        "unpainted": (finished.unpainted, None),
        "painted": (finished.final, None),
    }
    if postpaint or painter:
        variants["view-time"] = (finished.final, painter or parameters.painter)
    judge = evaluate_strips if protocol == "cross-camera" else evaluate_task
    scores = {}
    with shown_progress():
        for name, (fitted, chosen) in variants.items():
            judged = judge.fn(
                store.root,
                f"{protocol}-{name}",
                parameters.split_spec,
                fitted,
                parameters.judge_settings,
                chosen,
            )
            scores[name] = load_scores(judged.ref)
    record_scores(store, finished.run_id, finished.scene_id, scores)
    if protocol == "truth":
        scores = {name: _with_truth(found, finished.scene_id) for name, found in scores.items()}
    result = {"run_id": finished.run_id, "scene": finished.scene_id, "protocol": protocol, **scores}
    if as_json:
        print_json(result)
    elif protocol == "cross-camera":
        _show_strips(result, list(variants))
    else:
        _show(result, list(variants))


def _check(protocol: str, previous: str | None) -> None:
    """Refuse what cannot be judged before anything is loaded.

    Raises:
        ConfigError: no such protocol, or one that has no frames before.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"no protocol {protocol!r}, expected {', '.join(PROTOCOLS)}")
    if previous is not None and protocol != FLICKER:
        raise ConfigError(f"--previous is judged by --protocol {FLICKER}, not by {protocol}")


def _weights(features: Path | None, backbone: Path | None, heads: Path | None) -> dict[str, Any]:
    """The weights that are given; the run's own stay otherwise."""
    from lidarpainter_models.metrics.lpips import LpipsFiles

    changes: dict[str, Any] = {} if features is None else {"feature_weights": features}
    if backbone is not None or heads is not None:
        changes["lpips"] = LpipsFiles(backbone=backbone, heads=heads)
    return changes


def _with_truth(scores: dict[str, Any], scene_id: str) -> dict[str, Any]:
    """Only views whose true image is known beside the path.

    Raises:
        ConfigError: the scene has no such truth.
    """
    known = {name: found for name, found in scores["novel"].items() if found.get("psnr")}
    if not known:
        raise ConfigError(
            f"scene {scene_id} has no true images beside its path; only synthetic streets have"
        )
    return {"novel": known}


def _show(result: dict[str, Any], variants: list[str]) -> None:
    from tasks.evaluation.scores import metric_values

    numbers: dict[tuple[str, str, str], dict[str, float | None]] = {}
    for variant in variants:
        for protocol, trajectory, name, value, _reason in metric_values(result[variant]):
            numbers.setdefault((protocol, trajectory, name), {})[variant] = value
    rows = [
        [*key, *(found.get(name) for name in variants)]
        for key, found in numbers.items()
        if any(value is not None for value in found.values())
    ]
    title = f"{result['scene']}, run {result['run_id']}"
    print_table(title, ["truth", "view", "figure", *variants], rows, num_text_columns=3)


def _show_strips(result: dict[str, Any], variants: list[str]) -> None:
    rows = [
        [name, *(result[variant][name]["psnr"] for variant in variants)]
        for name in result[variants[0]]
    ]
    title = f"{result['scene']}, run {result['run_id']}: PSNR on strips seen by two cameras"
    print_table(title, ["judging camera", *variants], rows)
