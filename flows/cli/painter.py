"""`lidarpainter painter`: harvest pairs, train painters, judge them, and say what they are."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli import painter_costs
from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table
from flows.cli.painter_options import (
    parse_inputs,
    parse_paths,
    parse_seeds,
    with_length,
    write_painter,
)
from flows.cli.shared_options import AsJson

app = typer.Typer(help="Train painters, judge them, say what they are.", no_args_is_help=True)

Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="Any other setting: training.batch_size=4. May be repeated."),
]
Seeds = Annotated[
    str | None, typer.Option(help="Synthetic streets by seed: 1000:1004 or 1000,1007.")
]
Scenes = Annotated[
    list[str] | None, typer.Option("--scene", help="A stored scene. May be repeated.")
]
Split = Annotated[str, typer.Option(help="Split of recorded scenes: forward:17:8, alternate.")]
Cameras = Annotated[
    str | None, typer.Option(help="Cameras of recorded scenes, with commas between.")
]
Features = Annotated[
    Path | None, typer.Option(help="SqueezeNet 1.1 weights for the feature distance.")
]
Budget = Annotated[float | None, typer.Option(help="CPU seconds of training.")]
Steps = Annotated[int | None, typer.Option(help="Optimiser steps of training.")]
Base = Annotated[
    str | None,
    typer.Option(
        help="Train the one-step painter on this model: a folder in diffusers' layout or an id, "
        "with a preset after a colon. Without it, the small painter."
    ),
]
LpipsBackbone = Annotated[
    Path | None,
    typer.Option(help="torchvision's VGG-16, AlexNet or SqueezeNet 1.1, for the loss with --base."),
]
LpipsHeads = Annotated[
    Path | None, typer.Option(help="LPIPS 0.1 heads of the same network, for the loss.")
]


@app.command("harvest")
def harvest(
    seeds: Seeds = None,
    scenes: Scenes = None,
    split: Split = "alternate",
    cameras: Cameras = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Make pairs for training or judging; seeds below 1000 can only judge."""
    from flows.cli.training import harvest_parameters, run_harvest
    from flows.overrides import with_overrides

    parameters = harvest_parameters(parse_seeds(seeds), scenes, split, cameras)
    result = run_harvest(with_overrides(parameters, settings or []))
    if as_json:
        print_json(result)
    else:
        _show_pairs(result["pairs"])


@app.command("train")
def train(  # noqa: PLR0913 - the options of a command
    seeds: Seeds = None,
    scenes: Scenes = None,
    split: Split = "alternate",
    cameras: Cameras = None,
    pairs: Annotated[
        list[str] | None,
        typer.Option(help="A folder of pairs harvested before. May be repeated."),
    ] = None,
    budget: Budget = None,
    steps: Steps = None,
    base: Base = None,
    start: Annotated[
        Path | None, typer.Option(help="Go on from these weights: nano, or a .safetensors file.")
    ] = None,
    inputs: Annotated[
        str | None,
        typer.Option(help="What the small painter may see, with commas between; by default all."),
    ] = None,
    prompts: Annotated[
        str | None,
        typer.Option(help="clear, and styles to learn beside it: clear,foggy,night,rain."),
    ] = None,
    held_back: Annotated[
        float, typer.Option(help="Share of the true images kept from training, to judge by.")
    ] = 0.1,
    feature_weights: Features = None,
    lpips_backbone: LpipsBackbone = None,
    lpips_heads: LpipsHeads = None,
    processes: Annotated[
        int, typer.Option(min=1, help="Train with --base in so many processes, a GPU for each.")
    ] = 1,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder, or .safetensors file, for the weights and their record."),
    ] = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train the small painter, or with --base the one-step painter on a model.

    A killed training goes on where it stopped.
    """
    from flows.cli.shared_options import parse_names
    from flows.cli.training import first_choices, run_training, train_parameters
    from flows.overrides import with_changes, with_overrides

    parameters = train_parameters(
        parse_seeds(seeds), scenes, split, cameras, parse_paths(pairs, "--pairs")
    )
    changes = first_choices(base, start, lpips_backbone, lpips_heads)
    changes |= {
        "held_back": held_back,
        "feature_weights": feature_weights,
        "processes": processes,
    }
    parameters = with_changes(parameters, changes)
    training = with_length(
        parameters.training, parse_inputs(inputs), budget, steps, parse_names(prompts)
    )
    parameters = with_overrides(with_changes(parameters, {"training": training}), settings or [])
    result = run_training(parameters)
    if out is not None:
        result |= write_painter(Path(result["weights"]), result["record"], out)
    if as_json:
        print_json(result)
    else:
        _show_training(result)


@app.command("evaluate")
def evaluate(
    painters: Annotated[
        list[str], typer.Option("--painter", help="A name or a weights file. May be repeated.")
    ],
    pairs: Annotated[
        list[str] | None, typer.Option(help="A folder of pairs. May be repeated.")
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            "--run",
            help="A run (id, prefix or latest): its first fit is painted at held-out frames, or "
            "beside the path of a synthetic street. May be repeated.",
        ),
    ] = None,
    feature_weights: Features = None,
    keep_below: Annotated[
        float | None,
        typer.Option(
            help="Judge small painters again, leaving tiles unpainted that differ by less than "
            "this from LiDAR and warps; 0.01 say."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Judge painters on pairs, or views of a finished run, that none of them was trained on."""
    from flows.cli.training import judge

    found = judge(
        parse_paths(painters, "--painter"),
        parse_paths(pairs, "--pairs"),
        feature_weights,
        keep_below,
        runs or (),
    )
    if as_json:
        print_json(found)
    else:
        _show_scores(found)


@app.command("info")
def info(
    painter: Annotated[
        str | None, typer.Option(help="A painter's name (nano), a weights file, or a model.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help="A wiring of the one-step painter: paper, as-shipped, fast, ..."),
    ] = None,
    size: painter_costs.Size = "1024x576",
    as_json: AsJson = False,
) -> None:
    """Say what a painter is, what it costs and how it was trained."""
    if preset is not None:
        painter_costs.show_preset(painter, preset, size, as_json=as_json)
        return
    painter = painter or "nano"
    from lidarpainter_models.painter import PainterChoice, load_painter
    from lidarpainter_models.painter.description import describe_painter

    choice = PainterChoice.of(painter)
    found = describe_painter(load_painter(painter))
    result = {
        "painter": painter,
        "digest": choice.digest,
        "num_bytes": sum(path.stat().st_size for path in choice.files),
        **found,
    }
    if as_json:
        print_json(result)
    else:
        _show_info(result)


@app.command("ablate")
def ablate(  # noqa: PLR0913 - the options of a command
    pairs_train: Annotated[
        list[str], typer.Option(help="A folder of pairs to learn from. May be repeated.")
    ],
    pairs_test: Annotated[
        list[str], typer.Option(help="A folder of pairs to judge by. May be repeated.")
    ],
    tables: Annotated[
        str | None,
        typer.Option(
            "--table",
            help="inputs, fusion, lidar, skips, and with --base t, step; commas between.",
        ),
    ] = None,
    budget: Budget = None,
    steps: Steps = None,
    base: Base = None,
    feature_weights: Features = None,
    lpips_backbone: LpipsBackbone = None,
    lpips_heads: LpipsHeads = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train painters that differ in one input or part, a table per choice, and judge all alike.

    Small ones, or with --base one-step painters wired in different ways.
    """
    from flows.cli.shared_options import parse_names
    from flows.cli.training import ablation_parameters, first_choices, run_ablation
    from flows.overrides import with_changes, with_overrides

    parameters = ablation_parameters(
        parse_paths(pairs_train, "--pairs-train"),
        parse_paths(pairs_test, "--pairs-test"),
        parse_names(tables),
    )
    changes = first_choices(base, None, lpips_backbone, lpips_heads)
    parameters = with_changes(parameters, changes | {"feature_weights": feature_weights})
    training = with_length(parameters.training, None, budget, steps)
    parameters = with_overrides(with_changes(parameters, {"training": training}), settings or [])
    result = run_ablation(parameters)
    if as_json:
        print_json(result)
    else:
        _show_scores(result)


app.command("benchmark")(painter_costs.benchmark)


def _show_pairs(pairs: list[dict[str, Any]]) -> None:
    columns = ("set", "num_pairs", "num_targets", "cpu_seconds", "folder")
    rows = [[made[name] for name in columns] for made in pairs]
    print_table("pairs", ["set", "pairs", "true images", "CPU s", "folder"], rows)


def _show_training(result: dict[str, Any]) -> None:
    if result["held_back"] is not None:
        from tasks.painter.judge import PAINTING_COLUMNS, PAINTING_NOTE, painting_rows

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


def _show_scores(found: dict[str, Any]) -> None:
    from tasks.painter.judge import PAINTING_COLUMNS, PAINTING_NOTE, painting_rows

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


def _show_info(result: dict[str, Any]) -> None:
    pairs: dict[str, Cell] = {
        "architecture": result["architecture"]["summary"],
        "size": format_bytes(result["num_bytes"]),
        "parameters": result["num_parameters"],
        **{f"parameters, {name}": count for name, count in result["parameters"].items()},
        "precision here": result.get("precision"),
        "licence": result["licence"],
    }
    for name, value in (*result["architecture"].items(), *result["provenance"].items()):
        if name == "trained_targets":
            pairs["true images trained on"] = len(value)
        elif name != "summary":
            pairs[name] = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    print_pairs(f"painter {result['painter']}", pairs)
