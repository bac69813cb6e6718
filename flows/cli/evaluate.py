"""`lidarpainter evaluate`: judge a finished run again, or under another protocol."""

from pathlib import Path
from typing import Any

from flows.cli.output import print_json, print_table
from flows.cli.shared_options import (
    AsJson,
    check_painter,
    described,
    named_run,
    parse_previous,
    refuse_unused,
)
from lidarpainter_models.errors import ConfigError

FLICKER = "flicker"
CROSS_CAMERA = "cross-camera"
LIDAR = "lidar"
STRIP_FIGURES = {
    "psnr": "seen by both, calibrated",
    "uncalibrated_psnr": "seen by both, as delivered",
    "whole_image_psnr": "all, as delivered",
}
NEURAD, MARKINGS = "neurad", "markings"
PROTOCOLS = ("paper", "truth", NEURAD, CROSS_CAMERA, MARKINGS, FLICKER, LIDAR)
WEIGHTS = ("--feature-weights", "--lpips-backbone", "--lpips-heads", "--inception")
VARIANTS = ("unpainted", "painted", "refined", "view-time")
FLICKER_COLUMNS = ("flicker", "moving_flicker", "valid_share", "psnr", "num_pairs")

WORDS = """
protocol: How the run is scored: paper (held-out views, and views beside the path where they are
  known), truth (views beside the path of a synthetic street, against exact images), neurad (every
  held-out image at its recorded pose, FID there and beside the path, for runs with --split
  linspace: the protocol of neurad-studio), cross-camera (cameras that no fit saw), markings
  (painted lines, where LiDAR points tell them), flicker (neighbouring frames against each other),
  or lidar (simulated sweeps against those of held-out frames).
postpaint: Also score what is painted at view time.
painter: Painter at view time: overlay, warp, nano, a .safetensors file, or a model; the run's own
  if absent. Scores of another one are printed, but not entered into the catalog.
lpips_backbone: File with torchvision's weights of VGG-16, AlexNet or SqueezeNet, for LPIPS; it is
  left out if absent.
lpips_heads: File with the LPIPS heads (version 0.1) of the same network.
inception: File with the weights of Inception, for FID and KID, as pytorch-fid publishes it:
  pt_inception-2015-12-05-6726825d.pth; they are left out if absent.
all_views: Score every held-out view in place of a sample of them.
previous: With --protocol flicker: also score painting that uses the image painted before: mixed
  (into what the next one is painted from), shown (to the painter), or both with a comma between.
"""


@described(WORDS)
def evaluate(  # noqa: PLR0913 - the options of a command
    run: str,
    protocol: str = "paper",
    postpaint: bool = False,
    painter: str | None = None,
    feature_weights: Path | None = None,
    lpips_backbone: Path | None = None,
    lpips_heads: Path | None = None,
    inception: Path | None = None,
    all_views: bool = False,
    previous: str | None = None,
    as_json: AsJson = False,
) -> None:
    """Judge a finished run on views it never saw.

    Example: lidarpainter evaluate latest --protocol flicker --previous mixed
    """
    weights = (feature_weights, lpips_backbone, lpips_heads, inception)
    _check(protocol, previous, weights, all_views=all_views)
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress

    previously, run_id = parse_previous(previous), named_run(run)
    check_painter(painter)
    if protocol == LIDAR:
        refuse_unused(
            f"--protocol {LIDAR}", {"--postpaint": postpaint, "--painter": painter is not None}
        )
        _judge_lidar(run_id, as_json=as_json)
        return
    from flows.evaluate import EvaluationRequest, evaluate_run

    request = EvaluationRequest(
        run=run_id,
        protocol=protocol,
        is_painted=postpaint,
        painter=painter,
        changes=_weights(*weights),
        judges_all=all_views,
        previous=previously,
    )
    with shown_progress():
        result = evaluate_run(existing_store(), request)
    if as_json:
        print_json(result)
    else:
        {FLICKER: _show_flicker, CROSS_CAMERA: _show_strips}.get(protocol, _show)(result)


def _judge_lidar(run_id: str, *, as_json: bool) -> None:
    """Judge the simulated sweeps of a run, and show the figures."""
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.lidar import evaluate_lidar_run

    with shown_progress():
        result = evaluate_lidar_run(existing_store(), run_id)
    if as_json:
        print_json(result)
        return
    found = result[LIDAR]
    rows = [
        [protocol, name, value]
        for protocol in ("neurad-studio", "own")
        for name, value in found[protocol].items()
    ]
    title = f"{result['scene']}, run {result['run_id']}: {found['num_sweeps']} held-out sweeps"
    print_table(title, ["protocol", "figure", found["lidar"]], rows, num_text_columns=2)


def _check(
    protocol: str, previous: str | None, weights: tuple[Path | None, ...], *, all_views: bool
) -> None:
    """Refuse what cannot be judged before anything is loaded."""
    if protocol not in PROTOCOLS:
        raise ConfigError(f"--protocol {protocol!r}: expected {', '.join(PROTOCOLS)}")
    if previous is not None and protocol != FLICKER:
        raise ConfigError(f"--previous is judged by --protocol {FLICKER}, not by {protocol}")
    if protocol in (CROSS_CAMERA, MARKINGS, FLICKER, LIDAR):
        given = {name: path is not None for name, path in zip(WEIGHTS, weights, strict=True)}
        refuse_unused(f"--protocol {protocol}", {"--all-views": all_views, **given})


def _weights(
    features: Path | None, backbone: Path | None, heads: Path | None, inception: Path | None
) -> dict[str, Any]:
    """The weights that are given; the run's own stay otherwise."""
    from lidarpainter_models.metrics.lpips_files import LpipsFiles

    changes: dict[str, Any] = {} if features is None else {"feature_weights": features}
    if inception is not None:
        changes["inception"] = inception
    if backbone is not None or heads is not None:
        changes["lpips"] = LpipsFiles(backbone=backbone, heads=heads)
    return changes


def _show(result: dict[str, Any]) -> None:
    from lidarpainter_models.evaluation.score_tables import metric_values

    variants = [name for name in VARIANTS if name in result]
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


def _show_strips(result: dict[str, Any]) -> None:
    variants = [name for name in VARIANTS if name in result]
    rows = [
        [camera, truth, *(result[variant][camera].get(figure) for variant in variants)]
        for camera in result[variants[0]]
        for figure, truth in STRIP_FIGURES.items()
    ]
    title = f"{result['scene']}, run {result['run_id']}: PSNR of cameras that no fit saw"
    print_table(title, ["judging camera", "pixels", *variants], rows, num_text_columns=2)


def _show_flicker(result: dict[str, Any]) -> None:
    rows = [
        [shift, image, *(scores[name] for name in FLICKER_COLUMNS)]
        for shift, images in result[FLICKER].items()
        for image, scores in images.items()
    ]
    title = f"{result['scene']}, run {result['run_id']}: mean rgb difference of neighbouring frames"
    print_table(title, ["view", "image", *FLICKER_COLUMNS], rows, num_text_columns=2)
