"""`lidarpainter painter`: harvest pairs, train painters, judge them, and say what they are."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from flows.cli import painting_tables as tables
from flows.cli.output import print_json, say_status
from flows.cli.shared_options import AsJson, Settings, check_painter, described, parse_names
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from pydantic import BaseModel

    from flows.painter_parameters import TrainPainterParameters

_SIZE = re.compile(r"([1-9]\d{0,4})x([1-9]\d{0,4})")
_SEEDS = re.compile(r"(\d+)(?::(\d+))?")
MOST_STREETS = 10_000

app = typer.Typer(help="Train painters, judge them, say what they are.", no_args_is_help=True)

WORDS = """
seeds: Synthetic streets by their seeds: a range 1000:1004, the last excluded, or a list 1000,1007.
scenes: A stored scene as dataset/sequence. May be repeated.
split: Which frames of recorded scenes are fitted, the others giving true images: alternate,
  linspace, forward:17:8 or all, as `reconstruct --help` explains them.
cameras: Names of the cameras of recorded scenes, with commas between; all if absent.
settings: Changes one setting, such as training.steps=500; `lidarpainter settings --of train` lists
  them all. May be repeated.
pairs: A folder of pairs that were harvested before. May be repeated.
budget: The maximum CPU seconds of training; the default of the painter if absent.
steps: Number of optimiser steps of training; the default of the painter if absent.
base: Train the one-step painter on this model: a folder in diffusers' layout or an id, with a
  preset after a colon. Without it, the small painter.
start: Weights that training goes on from: nano, or a .safetensors file; it starts anew if absent.
inputs: Inputs that the small painter sees, of `lidarpainter painter info`, with commas between; all
  if absent.
prompts: Styles to learn, with commas between: clear, which must be among them, foggy, night and
  rain; clear alone if absent.
held_back: Share from 0 to 1 of the true images that is kept from training, to score by.
lpips_backbone: File with torchvision's weights of VGG-16, AlexNet or SqueezeNet 1.1, for the loss
  with --base.
lpips_heads: File with the LPIPS heads (version 0.1) of the same network, for the loss with --base.
device: Where painters run: auto (a GPU if there is one), cpu, cuda, or cuda:N for the N-th GPU.
processes: Number of processes that train with --base, each on a GPU of its own.
out: Folder, or .safetensors file, that the weights and their record are written to.
painters: A painter: overlay, warp, nano, a .safetensors file, or a model. May be repeated.
runs: A run by its id, the beginning of it, its scene, or latest: its first fit is painted at
  held-out frames, or beside the path of a synthetic street. May be repeated.
keep_below: Also score small painters that leave tiles unpainted which differ by less than this from
  LiDAR and warps, such as 0.01 of full scale.
painter: The painter: overlay, warp, nano, a .safetensors file, or a model.
size: Size of an image in pixels as WIDTHxHEIGHT, such as 1024x576.
repeats: Number of views that are painted in each precision.
pairs_train: A folder of harvested pairs to learn from. May be repeated.
pairs_test: A folder of harvested pairs to score by. May be repeated.
chosen: Tables to make, with commas between: inputs, fusion, lidar or skips; all if absent.
"""


@app.command("harvest")
@described(WORDS)
def harvest(
    seeds: str | None = None,
    scenes: Annotated[list[str] | None, typer.Option("--scene")] = None,
    split: str = "alternate",
    cameras: str | None = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Make pairs for training or judging; seeds below 1000 can only judge.

    Example: lidarpainter painter harvest --seeds 1000:1004
    """
    say_status("reading settings")
    from catalog.store import open_store
    from flows.overrides import with_overrides
    from flows.painter_parameters import HarvestParameters

    parameters = HarvestParameters(
        street_seeds=parse_seeds(seeds),
        scenes=tuple(scenes or ()),
        split=split,
        cameras=parse_names(cameras),
    )
    parameters = with_overrides(parameters, settings or [])
    from flows.train_painter import check_harvest, harvest_pairs

    check_harvest(parameters, open_store().address)
    result = _run(harvest_pairs, parameters)
    (print_json if as_json else tables.show_pairs)(result)


@app.command("train")
@described(WORDS)
def train(  # noqa: PLR0913 - the options of a command
    seeds: str | None = None,
    scenes: Annotated[list[str] | None, typer.Option("--scene")] = None,
    split: str = "alternate",
    cameras: str | None = None,
    pairs: list[str] | None = None,
    budget: float | None = None,
    steps: int | None = None,
    base: str | None = None,
    start: Path | None = None,
    inputs: str | None = None,
    prompts: str | None = None,
    held_back: float = 0.1,
    feature_weights: Path | None = None,
    lpips_backbone: Path | None = None,
    lpips_heads: Path | None = None,
    device: str = "auto",
    processes: Annotated[int, typer.Option(min=1)] = 1,
    out: Path | None = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train the small painter, or with --base one on a model; a killed training is taken up.

    Example: lidarpainter painter train --seeds 1000:1004 --budget 3600 --out painter

    In fog and at night too: lidarpainter painter train --seeds 1000 --prompts clear,foggy,night
    """
    say_status("reading settings")
    from flows.overrides import checked, with_overrides
    from flows.painter_parameters import TrainPainterParameters, shaped, started_at
    from lidarpainter_models.metrics.lpips_files import LpipsFiles

    asked = {
        "street_seeds": parse_seeds(seeds),
        "scenes": tuple(scenes or ()),
        "split": split,
        "cameras": parse_names(cameras),
        "pair_folders": parse_paths(pairs, "--pairs"),
        "held_back": held_back,
        "feature_weights": feature_weights,
        "device": device,
        "processes": processes,
    }
    start_at = started_at(base, start, LpipsFiles(backbone=lpips_backbone, heads=lpips_heads))
    parameters = checked(TrainPainterParameters, asked | start_at)
    training = shaped(
        parameters.training,
        inputs=parse_inputs(inputs),
        prompts=parse_names(prompts),
        budget_s=budget,
        steps=steps,
    )
    parameters = parameters.model_copy(update={"training": training})
    parameters = with_overrides(parameters, settings or [])
    (print_json if as_json else tables.show_training)(_trained(parameters, out))


def _trained(parameters: "TrainPainterParameters", out: Path | None) -> dict[str, Any]:
    """Train into the store, and copy the painter out of it if a place is given.

    What cannot be trained on, or written to, is refused before any work begins.
    """
    from catalog.folders import make_writable
    from catalog.store import open_store
    from flows.train_painter import check_sources, train_painter, write_painter
    from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX

    check_sources(parameters, open_store().address)
    if out is not None:
        make_writable(out.parent if out.suffix == WEIGHTS_SUFFIX else out, "--out")
    result = _run(train_painter, parameters)
    if out is None:
        return result
    return result | write_painter(Path(result["weights"]), result["record"], out)


@app.command("evaluate")
@described(WORDS)
def evaluate(
    painters: Annotated[list[str], typer.Option("--painter")],
    pairs: list[str] | None = None,
    runs: Annotated[list[str] | None, typer.Option("--run")] = None,
    feature_weights: Path | None = None,
    keep_below: float | None = None,
    device: str = "auto",
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
            parse_paths(painters, "--painter"),
            parse_paths(pairs, "--pairs"),
            runs or (),
            feature_weights=feature_weights,
            keep_below=keep_below,
            device=device,
        )
    (print_json if as_json else tables.show_scores)(found)


@app.command("info")
@described(WORDS)
def info(painter: str = "nano", as_json: AsJson = False) -> None:
    """Say what a painter is, in which precision it runs here, and how it was trained.

    Example: lidarpainter painter info --painter nano
    """
    say_status(f"opening {painter}")
    check_painter(painter)
    from flows.evaluate_painter import describe

    (print_json if as_json else tables.show_info)(describe(painter))


@app.command("benchmark")
@described(WORDS)
def benchmark(
    painter: str = "nano",
    size: str = "480x270",
    repeats: Annotated[int, typer.Option(min=1)] = 5,
    device: str = "auto",
    as_json: AsJson = False,
) -> None:
    """Time a painter's view on this machine, in float32 and in bfloat16.

    Example: lidarpainter painter benchmark --size 1024x576
    """
    say_status(f"opening {painter}")
    check_painter(painter)
    from flows.evaluate_painter import benchmark_painter

    found = benchmark_painter(painter, parse_size(size), repeats, device)
    (print_json if as_json else tables.show_times)(found)


@app.command("ablate")
@described(WORDS)
def ablate(  # noqa: PLR0913 - the options of a command
    pairs_train: Annotated[list[str], typer.Option()],
    pairs_test: Annotated[list[str], typer.Option()],
    chosen: Annotated[str | None, typer.Option("--table")] = None,
    budget: float | None = None,
    steps: int | None = None,
    feature_weights: Path | None = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Train small painters that differ in one input or part and judge all alike, in tables.

    Example: lidarpainter painter ablate --pairs-train DIR --pairs-test DIR --table inputs
    """
    say_status("reading settings")
    from flows.ablate_painter import AblationParameters, ablate_painter, check_ablation
    from flows.overrides import with_overrides
    from flows.painter_parameters import shaped
    from lidarpainter_models.painter.nano.training import NanoTrainingConfig

    nano = cast("NanoTrainingConfig", shaped(NanoTrainingConfig(), budget_s=budget, steps=steps))
    parameters = AblationParameters(
        train_folders=parse_paths(pairs_train, "--pairs-train"),
        test_folders=parse_paths(pairs_test, "--pairs-test"),
        chosen=parse_names(chosen),
        training=nano,
        feature_weights=feature_weights,
    )
    parameters = with_overrides(parameters, settings or [])
    check_ablation(parameters)
    (print_json if as_json else tables.show_scores)(_run(ablate_painter, parameters))


def _run(flow: Callable[..., dict[str, Any]], parameters: "BaseModel") -> dict[str, Any]:
    """Run a flow with a Prefect server and progress on stderr."""
    from catalog.store import open_store
    from flows.cli.progress import shown_progress
    from flows.server import prefect_server

    store = open_store()
    store.make()
    say_status("starting Prefect's server")
    with prefect_server(store.root / "logs" / "prefect.log"), shown_progress():
        return flow(parameters, store.address)


def parse_seeds(text: str | None) -> tuple[int, ...]:
    """`1000:1004` (the last excluded), `1000,1007`, or both mixed.

    Raises:
        ConfigError: the text says something else, names a seed twice, or too many.
    """
    if text is None:
        return ()
    seeds: list[int] = []
    for part in text.split(","):
        match = _SEEDS.fullmatch(part.strip())
        chosen = range(0)
        if match:
            first = int(match[1])
            chosen = range(first, int(match[2]) if match[2] else first + 1)
        if not chosen:
            raise ConfigError(f"seeds {text!r}: expected such as 1000:1004 or 1000,1007")
        if len(seeds) + chosen.stop - chosen.start > MOST_STREETS:
            raise ConfigError(f"seeds {text!r}: expected at most {MOST_STREETS} streets")
        seeds += chosen
    if len(set(seeds)) != len(seeds):
        raise ConfigError(f"seeds {text!r}: a seed is named twice")
    return tuple(seeds)


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of an image: `1024x576`.

    Raises:
        ConfigError: the text says something else.
    """
    match = _SIZE.fullmatch(text)
    if match is None:
        raise ConfigError(f"size {text!r}: expected such as 1024x576")
    return int(match[1]), int(match[2])


def parse_inputs(text: str | None) -> frozenset[str] | None:
    """Names of the small painter's inputs with commas between.

    Raises:
        ConfigError: the network cannot be built from them.
    """
    from lidarpainter_models.painter.nano.candidates import check_inputs

    if text is None:
        return None
    return check_inputs(part.strip() for part in text.split(","))


def parse_paths(texts: Sequence[str] | None, option: str) -> tuple[Path, ...]:
    """Paths or names, given by repeating an option or with commas between.

    Raises:
        ConfigError: one is empty or given twice.
    """
    paths = tuple(part.strip() for text in texts or () for part in text.split(","))
    if not all(paths) or len(set(paths)) != len(paths):
        raise ConfigError(f"{option} {','.join(texts or ())!r}: expected each once, none empty")
    return tuple(Path(path) for path in paths)
