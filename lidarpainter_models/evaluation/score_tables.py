"""Scores of an evaluation: every number by its name, and the table of them."""

from collections.abc import Mapping
from typing import Any, Literal

DEPTH = "depth_within_5_percent"
FLICKER = "flicker"
"""Entry of an evaluation that compared neighbouring frames."""
NEURAD = "neurad"
"""Entry of an evaluation by the protocol of neurad-studio, by camera and by shift."""
LIKENESS = {"fid", "kid"}
"""Figures that compare a set of images with recorded images of other places."""
LIDAR = "lidar"
"""Entry of an evaluation that judged simulated sweeps."""
MARKINGS = "markings"
"""Entry of an evaluation of painted lines, by trajectory."""
FEW_RAYS = "too few rays, or the log does not tell which were lost"
ENVELOPE = "envelope"
"""Entry of the scores of a run: how far beside the path the scene can be trusted."""
HELD_OUT = "held_out"
"""Entry of an envelope: how held-out frames of the log part from what was predicted of them."""
TRUSTED = ("left_m", "right_m", "up_m", "ahead_m", "yaw_left_deg", "yaw_right_deg")
"""What an envelope says of a stretch, in metres and degrees."""
UNTRUSTED = "a stretch is not trusted even on the recorded path"
FIGURES = ("PSNR", "SSIM", "depth")
SCORE_NOTE = "PSNR in dB; depth: part of unseen LiDAR pixels that the rendered depth meets in 5 %."

ScoreCell = str | float | int | None
Scores = dict[str, Any]
"""`recorded` and `novel` as `reconstruct --json` prints them."""
MetricRow = tuple[str, str, str, float | None, str | None]


def metric_values(scores: Mapping[str, Any]) -> list[MetricRow]:
    """Every number as (protocol, trajectory, name, value, reason why there is none).

    Scores of strips have neither recorded nor novel views, but judging cameras; those of flicker
    have shifted paths alone, those by the protocol of neurad-studio cameras and shifts, those of
    markings trajectories, and those of sweeps figures by whose protocol they are.
    """
    if "recorded" not in scores:
        return _by_part(scores)
    recorded = scores["recorded"]
    found: list[MetricRow] = []
    for protocol, values in (
        ("recorded", recorded),
        ("recorded-poses", recorded.get("recorded_poses", {})),
    ):
        for name, value in _numbers(values):
            found.append((protocol, "recorded", name, value, _reason(recorded, name, value)))
    for trajectory, values in scores["novel"].items():
        for name, value in _numbers(values):
            place = (_truth_of(name), trajectory, name)
            found.append((*place, value, _reason(values, name, value)))
    if envelope := scores.get(ENVELOPE):
        for name, value in least_of(envelope).items():
            reason = UNTRUSTED if value is None else None
            found.append((ENVELOPE, *_trusted_name(name), value, reason))
    more = [name for name in (LIDAR, MARKINGS) if name in scores]
    return found + [row for name in more for row in _by_part({name: scores[name]})]


def _truth_of(name: str) -> str:
    """What a figure beside the path was taken against."""
    if name in LIKENESS:
        return "likeness"
    return "depth" if name.startswith("depth") else "truth"


def _by_part(scores: Mapping[str, Any]) -> list[MetricRow]:
    """Numbers of what was not judged as held-out views are, by camera, path or protocol."""
    name_of = next(
        (name for name in (NEURAD, LIDAR, FLICKER, MARKINGS) if name in scores), "cross-camera"
    )
    parts = dict(scores.get(name_of, scores))
    if name_of == LIDAR:
        parts = {name: parts[name] for name in ("neurad-studio", "own")}
    few = FEW_RAYS if name_of == LIDAR else None
    return [
        (name_of, part, name, value, values.get(f"{name}_reason", few) if value is None else None)
        for part, values in parts.items()
        for name, value in _numbers(values)
    ]


def least_of(envelope: Mapping[str, Any]) -> dict[str, float | None]:
    """The least over all stretches of an envelope, by direction; None where one is not trusted."""
    rows = envelope["stretches"]
    return {
        name: None if any(row[name] is None for row in rows) else min(row[name] for row in rows)
        for name in TRUSTED
    }


def values_by_view(
    scores: Mapping[str, Any],
) -> dict[tuple[str, str, str], dict[str, float | None]]:
    """What means over views are the mean of: by protocol, trajectory and name, then by view.

    Of an envelope what the least over stretches is the least of, by stretch: `0-19m`.
    """
    recorded = scores.get("recorded") or {}
    found = {("recorded", "recorded"): recorded}
    found |= {("recorded-poses", "recorded"): recorded.get("recorded_poses", {})}
    found |= {("truth", name): values for name, values in (scores.get("novel") or {}).items()}
    by_view = {
        (*place, "psnr"): values["psnr_by_view"]
        for place, values in found.items()
        if "psnr_by_view" in values
    }
    if envelope := scores.get(ENVELOPE):
        for name in TRUSTED:
            by_view[ENVELOPE, *_trusted_name(name)] = {
                f"{row['from_m']:.0f}-{row['to_m']:.0f}m": row[name]
                for row in envelope["stretches"]
            }
    return by_view


def _trusted_name(name: str) -> tuple[str, str]:
    """Trajectory and name of a figure of the envelope: `yaw-left`, `trusted_deg`."""
    direction, _, unit = name.rpartition("_")
    return direction.replace("_", "-"), f"trusted_{unit}"


def _reason(values: Mapping[str, Any], name: str, value: float | None) -> str | None:
    """Why there is no number."""
    if value is None and name == "feature_distance":
        return "the feature distance needs weights: --feature-weights"
    return values.get(f"{name}_reason") if value is None else None


def flicker_by_image(flicker: Mapping[str, Mapping[str, Any]]) -> dict[str, Scores]:
    """Flicker by shift and image as the catalog takes it: by image, then by shift."""
    images = sorted({name for found in flicker.values() for name in found})
    return {
        image: {FLICKER: {shift: found[image] for shift, found in flicker.items()}}
        for image in images
    }


def _numbers(values: Mapping[str, Any]) -> list[tuple[str, float | None]]:
    return [
        (name, None if value is None else float(value))
        for name, value in values.items()
        if not name.startswith("num_") and (value is None or isinstance(value, (int, float)))
    ]


def fitted_on(painter: str) -> Literal["painted", "refined"]:
    """What the scene after the last round is called: without a painter it is not painted."""
    from lidarpainter_models.painter.known_painters import NO_PAINTER

    return "refined" if painter == NO_PAINTER else "painted"


def score_columns(painter: str) -> list[str]:
    """The columns of `score_rows`, by what the painter of the run was."""
    pairs = [(f"unpainted {figure}", f"{fitted_on(painter)} {figure}") for figure in FIGURES]
    return ["view", *(name for pair in pairs for name in pair), "views"]


def score_rows(result: Mapping[str, Any]) -> list[list[ScoreCell]]:
    """One row per place the camera was at; `result` is that of `reconstruct`, perhaps unjudged."""
    if result["recorded"] is None:
        return []
    before, after = result["unpainted"], result
    rows = [
        _row("recorded, interpolated poses", before["recorded"], after["recorded"]),
        _row(
            "recorded, recorded poses",
            before["recorded"].get("recorded_poses", {}),
            after["recorded"].get("recorded_poses", {}),
        ),
        _actors(before["recorded"], after["recorded"]),
    ]
    for name, values in after["novel"].items():
        rows.append(_row(name, before["novel"].get(name, {}), values))
    return rows


def _row(name: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> list[ScoreCell]:
    numbers = [values.get(key) for key in ("psnr", "ssim", DEPTH) for values in (before, after)]
    return [name, *numbers, after.get("num_views")]


def _actors(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[ScoreCell]:
    psnr = [values.get("actors_psnr") for values in (before, after)]
    return ["recorded, inside actor boxes", *psnr, None, None, None, None, after.get("num_views")]
