"""What the commands of `lidarpainter painter` print: pairs, trainings, scores, times."""

from collections.abc import Iterator, Mapping
from typing import Any

import typer

from flows.cli.output import Cell, format_bytes, print_pairs, print_table

PAINTING_COLUMNS = (
    "image",
    "PSNR",
    "SSIM",
    "features",
    "damaged",
    "undamaged",
    "outside hull, %",
    "confidence AUC",
    "CPU ms",
    "kept, %",
)
PAINTING_NOTE = (
    "PSNR, damaged and undamaged in dB; damaged: error of the render above 0.1; outside hull: more "
    "than 0.05 beyond what any input shows within 9x9 pixels; AUC: of the confidence for an error "
    "above 0.05; features: SqueezeNet distance, with --feature-weights; kept: left unpainted."
)
DIGEST_SHOWN = 12
FIGURES = ("psnr", "ssim", "feature_distance", "damaged_psnr", "undamaged_psnr")


def painting_rows(
    scores: Mapping[str, Mapping[str, Any]], source: str | None = None
) -> list[list[Cell]]:
    """A row for the render, one for the mean of the warps, and one per painter.

    `source` is the set of pairs to show, None all together.
    """
    found = {
        label: one["total"] if source is None else one["sources"][source]
        for label, one in scores.items()
    }
    first = next(iter(found.values()))
    rows = [
        [*_figures("input render", first["input"]), None, None, None],
        [*_figures("mean with warps", first["warp_mean"]), None, None, None],
    ]
    for label, one in found.items():
        painted = _figures(label, one["painted"])
        rows.append(
            [*painted, one["confidence_auc"], one["cpu_ms_per_frame"], 100 * one["kept_share"]]
        )
    return rows


def _figures(label: str, image: Mapping[str, Any]) -> list[Cell]:
    return [label, *(image[name] for name in FIGURES), 100 * image["outside_hull"]]


def show_pairs(result: dict[str, Any]) -> None:
    """What was harvested."""
    columns = ("set", "num_pairs", "num_targets", "cpu_seconds", "folder")
    rows = [[made[name] for name in columns] for made in result["pairs"]]
    print_table("pairs", ["set", "pairs", "true images", "CPU s", "folder"], rows)


def show_training(result: dict[str, Any]) -> None:
    """What a training has made, and how it stands on what was held back."""
    if result["held_back"] is not None:
        rows = painting_rows({"painted": result["held_back"]})
        count = result["held_back"]["total"]["num_pairs"]
        print_table(f"{count} pairs held back", PAINTING_COLUMNS, rows, PAINTING_NOTE)
    pairs: dict[str, Cell] = {
        "painter": result["painter_id"],
        "weights": result["weights"],
        "size": format_bytes(result["num_bytes"]),
        "steps": result["record"]["steps"],
        "pairs": result["record"]["num_pairs"],
        "training, CPU s": result["record"]["cpu_s"],
        "record": result.get("record_path"),
        "sample images": result["samples"],
    }
    print_pairs("painter", pairs)


def show_scores(found: dict[str, Any]) -> None:
    """Scores of painters, a table per choice and source."""
    judged = {name: counts for name, counts in found["pairs"].items() if counts["num_judged"]}
    sources: list[str | None] = [*judged, None] if len(judged) > 1 else [None]
    tables = found.get("tables") or {"": {label: label for label in found["painters"]}}
    for choice, labels in tables.items():
        shown = {value: found["painters"][label] for value, label in labels.items()}
        for source in sources:
            count = sum(one["num_judged"] for name, one in judged.items() if source in (None, name))
            title = f"{choice}, {source or 'all'}: {count} pairs".removeprefix(", ")
            note = PAINTING_NOTE if source is None else ""
            print_table(title, PAINTING_COLUMNS, painting_rows(shown, source), note)
    for name, counts in found["pairs"].items():
        if counts["num_left_out"]:
            typer.echo(f"{name}: {counts['num_left_out']} pairs left out, a painter knows them")
    for label in found["training_unknown"]:
        typer.echo(f"{label}: its weights do not say which pairs it was trained on")


def show_info(result: dict[str, Any]) -> None:
    """What a painter is, its parts, the trainings that made it and what the last one learnt from.

    Whole digests are in the JSON.
    """
    provenance = dict(result["provenance"])
    pairs: dict[str, Cell] = {
        "architecture": result["architecture"]["summary"],
        "size": format_bytes(result["num_bytes"]),
        "parameters": result["num_parameters"],
        "precision here": result.get("precision"),
        "licence": result["licence"],
    }
    learnt, trainings = provenance.pop("pairs", {}), list(_trainings(provenance))
    provenance.pop("started_from", None)
    for name, value in (*result["architecture"].items(), *provenance.items()):
        if name == "trained_targets":
            pairs["true images trained on"] = len(value)
        elif name != "summary" and value is not None:
            is_list = isinstance(value, (list, tuple))
            pairs[name] = ", ".join(map(str, value)) if is_list else str(value)
    print_pairs(f"painter {result['painter']}", pairs)
    if result["parameters"]:
        print_table("parts", ["part", "parameters"], list(result["parameters"].items()))
    if len(trainings) > 1:
        columns = ["digest", "steps", "CPU s", "pairs"]
        print_table("trainings, each begun with the weights of the next", columns, trainings)
    if learnt:
        rows = [[name, one.get("num_pairs"), _short(one)] for name, one in learnt.items()]
        print_table("pairs that the last training learnt from", ["set", "pairs", "digest"], rows)


def _trainings(provenance: Mapping[str, Any]) -> Iterator[list[Cell]]:
    """A row for every training, the last one first."""
    one: Mapping[str, Any] | None = provenance
    while isinstance(one, Mapping):
        digest = _short({"digest": one.get("training_digest")})
        yield [digest, *(one.get(name) for name in ("steps", "cpu_s", "num_pairs"))]
        one = one.get("started_from")


def _short(found: Mapping[str, Any]) -> str:
    return str(found.get("digest") or "")[:DIGEST_SHOWN]


def show_times(result: dict[str, Any]) -> None:
    """How long a view takes in each precision."""
    rows: list[list[Cell]] = [
        [
            f"{row['precision'] or 'rule'}{', chosen' if row['is_chosen'] else ''}",
            row["cpu_ms"],
            row["wall_ms"],
            format_bytes(row["peak_memory_bytes"]),
        ]
        for row in result["times"]
    ]
    width_px, height_px = result["size_px"]
    title = (
        f"{result['painter']}, {width_px}x{height_px}, {result['device']} "
        f"({result['cpu_capability']}), {result['threads']} threads"
    )
    note = "medians of a view of noise; peak of the process so far"
    print_table(title, ["precision", "CPU ms", "wall ms", "peak memory"], rows, note)
