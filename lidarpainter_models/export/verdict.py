"""What is good and what is bad about a scene, in sentences that follow from its figures."""

from collections.abc import Mapping, Sequence
from typing import Any

from lidarpainter_models.evaluation.score_tables import (
    DEPTH,
    ENVELOPE,
    HELD_OUT,
    TRUSTED,
    fitted_on,
)

CLOSE_DB, FAIR_DB = 30.0, 26.0
"""From here on a view is close to its photograph, or good but soft; measured streets lie between
25 and 33 dB."""
WORSE_DB = 1.0
"""Actors that lie so far below the whole image are named."""
SOUND_DEPTH, WEAK_DEPTH = 0.95, 0.85
"""Part of LiDAR pixels that a sound surface meets, and one that is torn."""
TELLING = 0.005
"""Smaller changes of that part are noise between runs."""


def verdict(result: Mapping[str, Any]) -> list[str]:
    """Sentences about recorded views, views aside, and actors.

    Args:
        result: what `reconstruct --json` prints of a run; entries of older runs may lack.
    """
    if (recorded := result.get("recorded")) is None:
        judged = ["Nobody judged this scene: `lidarpainter evaluate` does."]
    else:
        envelope = result.get(ENVELOPE) or {"stretches": ()}
        weak = [row for row in envelope["stretches"] if row["left_m"] is None]
        judged = [
            _recorded(recorded, is_even=not weak),
            _aside(result),
            _trusted(envelope, weak),
            _checked(envelope.get(HELD_OUT)),
            _actors(recorded),
        ]
    early = "The fit ended early, at its time limit." if result.get("stopped_early") else ""
    sentences = (*judged, early, _taken_back(result.get("gains") or {}))
    return [sentence for sentence in sentences if sentence]


def _recorded(scores: Mapping[str, Any], *, is_even: bool) -> str:
    """How close held-out views are on average; `is_even` is that no stretch falls behind."""
    psnr = scores.get("psnr")
    if psnr is None:
        return "No frame was held back, so nothing says how it shows what it has not seen."
    if psnr >= CLOSE_DB and not is_even:
        words = "Uneven: along the recorded path it is close to photographs it never saw on average"
    elif psnr >= CLOSE_DB:
        words = "Good: along the recorded path it is close to photographs it never saw"
    elif psnr >= FAIR_DB:
        words = "Fair: along the recorded path it shows what is there, fine detail is soft"
    else:
        words = "Poor: even along the recorded path it is blurred or torn"
    judged, held_out = scores["num_views"], scores.get("num_held_out", scores["num_views"])
    of_all = "" if judged == held_out else f" of {held_out}"
    return f"{words} ({psnr:.1f} dB over {judged}{of_all} held-out views)."


def _taken_back(gains: Mapping[str, Mapping[str, Any]]) -> str:
    """Which painted rounds were taken back, and why."""
    return " ".join(
        f"Round {stage.rpartition('-')[2]} was taken back and made again without paintings: by "
        f"what vouches for views beside the path it made them worse ({gain['before_db']:.1f} to "
        f"{gain['after_db']:.1f} dB)."
        for stage, gain in gains.items()
        if gain["is_taken_back"]
    )


def _aside(result: Mapping[str, Any]) -> str:
    depths = {name: values.get(DEPTH) for name, values in (result.get("novel") or {}).items()}
    known = {name: value for name, value in depths.items() if value is not None}
    if not known:
        return "Beside the path nothing measured it."
    worst = min(known, key=lambda name: known[name])
    part = known[worst]
    if part >= SOUND_DEPTH:
        words = "Good: surfaces hold wherever it was tried"
    elif part >= WEAK_DEPTH:
        words = "Fair: surfaces beside the path hold, with holes"
    else:
        words = "Poor: surfaces beside the path tear"
    sentence = f"{words}; worst is {worst}, where {part:.0%} of LiDAR pixels are met"
    before = ((result.get("unpainted") or {}).get("novel") or {}).get(worst, {}).get(DEPTH)
    if before is None or fitted_on(result["painter"]) == "refined":
        return f"{sentence}."
    gain = part - before
    if abs(gain) < TELLING:
        return f"{sentence}; painting changed nothing there."
    did = "helped" if gain > 0 else "made it worse"
    return f"{sentence}; painting {did} there ({before:.0%} before)."


def _trusted(envelope: Mapping[str, Any], weak: Sequence[Mapping[str, Any]]) -> str:
    """How far single frames can be trusted; the page has a table of the stretches."""
    rows = envelope["stretches"]
    if not rows:
        return ""
    good_db, strong = envelope["good_db"], [row for row in rows if row not in weak]
    doubt = (
        f"On {len(weak)} of {len(rows)} stretches single frames may fall below {good_db:g} dB even "
        "on the recorded path, whatever the average is"
    )
    if not strong:
        return f"Weak: {doubt[0].lower()}{doubt[1:]}."
    least = {name: min(row[name] for row in strong) for name in TRUSTED}
    metres = ", ".join(f"{least[name]:g} m {name.removesuffix('_m')}" for name in TRUSTED[:4])
    turns = min(least["yaw_left_deg"], least["yaw_right_deg"])
    where = f"{doubt}; on the others every frame is" if weak else "All along, every frame is"
    return (
        f"{where} to be trusted ({good_db:g} dB or more) up to {metres}, {turns:g} degrees of yaw."
    )


def _checked(held_out: Mapping[str, Any] | None) -> str:
    """Whether what can be trusted was checked on the log itself; None is of an older run."""
    if held_out is None:
        return ""
    residual_db = held_out["residual_db"]
    if residual_db is None:
        return (
            "How far it can be trusted is not checked against held-out frames of this log: "
            "less is promised."
        )
    if not held_out["is_unlike"]:
        return ""
    way = "better" if residual_db > 0 else "worse"
    return (
        f"This log is unlike the streets that confidence is calibrated on: its held-out frames are "
        f"{abs(residual_db):.1f} dB {way} than predicted, and what is promised follows them."
    )


def _actors(scores: Mapping[str, Any]) -> str:
    inside, whole = scores.get("actors_psnr"), scores.get("psnr")
    if inside is None or whole is None:
        return "No moving actor was judged."
    if whole - inside > WORSE_DB:
        return (
            f"Weak: moving actors are worse than the street ({inside:.1f} against {whole:.1f} dB)."
        )
    return f"Good: moving actors are as sharp as the street ({inside:.1f} against {whole:.1f} dB)."
