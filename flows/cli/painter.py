"""`lidarpainter painter`: harvest pairs, train painters, judge them, and say what they are."""

from collections.abc import Callable
from typing import Annotated, Any

import typer

from flows.cli import painter_options as options
from flows.cli import painting_tables as tables
from flows.cli.output import print_json, say_status
from flows.cli.shared_options import AsJson, check_painter, parse_names

app = typer.Typer(help="Train painters, judge them, say what they are.", no_args_is_help=True)


@app.command("harvest")
def harvest(
    seeds: options.Seeds = None,
    scenes: options.Scenes = None,
    split: options.Split = "alternate",
    cameras: options.Cameras = None,
    settings: options.Settings = None,
    as_json: AsJson = False,
) -> None:
    """Make pairs for training or judging; seeds below 1000 can only judge.

    Example: lidarpainter painter harvest --seeds 1000:1004
    """
    say_status("reading settings")
    from flows.overrides import with_overrides
    from flows.painter_parameters import HarvestParameters

    parameters = HarvestParameters(
        street_seeds=options.parse_seeds(seeds),
        scenes=tuple(scenes or ()),
        split=split,
        cameras=parse_names(cameras),
    )
    parameters = with_overrides(parameters, settings or [])
    from flows.cli.training import run_harvest

    result = run_harvest(parameters)
    _print(result, lambda found: tables.show_pairs(found["pairs"]), as_json=as_json)


@app.command("train")
def train(  # noqa: PLR0913 - the options of a command
    seeds: options.Seeds = None,
    scenes: options.Scenes = None,
    split: options.Split = "alternate",
    cameras: options.Cameras = None,
    pairs: options.Pairs = None,
    budget: options.Budget = None,
    steps: options.Steps = None,
    base: options.Base = None,
    start: options.Start = None,
    inputs: options.Inputs = None,
    prompts: options.Prompts = None,
    held_back: options.HeldBack = 0.1,
    feature_weights: options.Features = None,
    lpips_backbone: options.LpipsBackbone = None,
    lpips_heads: options.LpipsHeads = None,
    device: options.Device = "auto",
    processes: options.Processes = 1,
    out: options.Out = None,
    settings: options.Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train the small painter, or with --base one on a model; a killed training is taken up.

    Example: lidarpainter painter train --seeds 1000:1004 --budget 3600 --out painter

    In fog and at night too: lidarpainter painter train --seeds 1000 --prompts clear,foggy,night
    """
    say_status("reading settings")
    from flows.overrides import checked, with_overrides
    from flows.painter_parameters import TrainPainterParameters
    from flows.painter_recipes import shaped, started_at
    from lidarpainter_models.metrics.lpips_files import LpipsFiles

    asked = {
        "street_seeds": options.parse_seeds(seeds),
        "scenes": tuple(scenes or ()),
        "split": split,
        "cameras": parse_names(cameras),
        "pair_folders": options.parse_paths(pairs, "--pairs"),
        "held_back": held_back,
        "feature_weights": feature_weights,
        "device": device,
        "processes": processes,
    }
    start_at = started_at(base, start, LpipsFiles(backbone=lpips_backbone, heads=lpips_heads))
    parameters = checked(TrainPainterParameters, asked | start_at)
    training = shaped(
        parameters.training,
        inputs=options.parse_inputs(inputs),
        prompts=parse_names(prompts),
        budget_s=budget,
        steps=steps,
    )
    parameters = parameters.model_copy(update={"training": training})
    parameters = with_overrides(parameters, settings or [])
    from flows.cli.training import run_training

    _print(run_training(parameters, out), tables.show_training, as_json=as_json)


@app.command("evaluate")
def evaluate(
    painters: Annotated[
        list[str],
        typer.Option(
            "--painter",
            help="A painter: overlay, warp, nano, a .safetensors file, or a model. "
            "May be repeated.",
        ),
    ],
    pairs: options.Pairs = None,
    runs: Annotated[
        list[str] | None,
        typer.Option(
            "--run",
            help="A run by its id, the beginning of it, its scene, or latest: its first fit is "
            "painted at held-out frames, or beside the path of a synthetic street. May be "
            "repeated.",
        ),
    ] = None,
    feature_weights: options.Features = None,
    keep_below: Annotated[
        float | None,
        typer.Option(
            help="Also score small painters that leave tiles unpainted which differ by less than "
            "this from LiDAR and warps, such as 0.01 of full scale."
        ),
    ] = None,
    device: options.Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Judge painters on pairs, or views of a finished run, that none of them was trained on.

    Example: lidarpainter painter evaluate --painter nano --painter warp --run latest
    """
    say_status("opening painters")
    from flows.cli.progress import shown_progress
    from flows.evaluate_painter import evaluate_painters

    with shown_progress():
        found = evaluate_painters(
            options.parse_paths(painters, "--painter"),
            options.parse_paths(pairs, "--pairs"),
            runs or (),
            feature_weights=feature_weights,
            keep_below=keep_below,
            device=device,
        )
    _print(found, tables.show_scores, as_json=as_json)


@app.command("info")
def info(
    painter: Annotated[
        str, typer.Option(help="The painter: overlay, warp, nano, a .safetensors file, or a model.")
    ] = "nano",
    as_json: AsJson = False,
) -> None:
    """Say what a painter is, in which precision it runs here, and how it was trained.

    Example: lidarpainter painter info --painter nano
    """
    say_status(f"opening {painter}")
    check_painter(painter)
    from flows.evaluate_painter import describe

    _print(describe(painter), tables.show_info, as_json=as_json)


@app.command("benchmark")
def benchmark(
    painter: Annotated[
        str, typer.Option(help="The painter: overlay, warp, nano, a .safetensors file, or a model.")
    ] = "nano",
    size: Annotated[
        str, typer.Option(help="Size of an image in pixels as WIDTHxHEIGHT, such as 1024x576.")
    ] = "480x270",
    repeats: Annotated[
        int, typer.Option(min=1, help="Number of views that are painted in each precision.")
    ] = 5,
    device: options.Device = "auto",
    as_json: AsJson = False,
) -> None:
    """Time a painter's view on this machine, in float32 and in bfloat16.

    Example: lidarpainter painter benchmark --size 1024x576
    """
    say_status(f"opening {painter}")
    check_painter(painter)
    from flows.evaluate_painter import benchmark_painter

    found = benchmark_painter(painter, options.parse_size(size), repeats, device)
    _print(found, tables.show_times, as_json=as_json)


@app.command("ablate")
def ablate(  # noqa: PLR0913 - the options of a command
    pairs_train: Annotated[
        list[str], typer.Option(help="A folder of harvested pairs to learn from. May be repeated.")
    ],
    pairs_test: Annotated[
        list[str], typer.Option(help="A folder of harvested pairs to score by. May be repeated.")
    ],
    chosen: Annotated[
        str | None,
        typer.Option(
            "--table",
            help="Tables to make, with commas between: inputs, fusion, lidar or skips; all if "
            "absent.",
        ),
    ] = None,
    budget: options.Budget = None,
    steps: options.Steps = None,
    feature_weights: options.Features = None,
    settings: options.Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train small painters that differ in one input or part and judge all alike, in tables.

    Example: lidarpainter painter ablate --pairs-train DIR --pairs-test DIR --table inputs
    """
    say_status("reading settings")
    from flows.ablate_painter import AblationParameters
    from flows.cli.training import run_ablation
    from flows.overrides import with_overrides
    from flows.painter_recipes import shaped
    from lidarpainter_models.painter.nano.training import NanoTrainingConfig

    parameters = AblationParameters(
        train_folders=options.parse_paths(pairs_train, "--pairs-train"),
        test_folders=options.parse_paths(pairs_test, "--pairs-test"),
        chosen=parse_names(chosen),
        training=shaped(NanoTrainingConfig(), budget_s=budget, steps=steps),
        feature_weights=feature_weights,
    )
    result = run_ablation(with_overrides(parameters, settings or []))
    _print(result, tables.show_scores, as_json=as_json)


def _print(found: dict[str, Any], show: Callable[[dict[str, Any]], None], *, as_json: bool) -> None:
    if as_json:
        print_json(found)
    else:
        show(found)
