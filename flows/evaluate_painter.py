"""Questions about painters that are answered here and now; nothing is stored."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from catalog.store import existing_store
from flows.parameters import view_parameters
from lidarpainter_models.devices import Device, chosen_device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.description import describe_painter, time_views
from lidarpainter_models.painter.precision import faster_type, type_name
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.training_data.pairs import named_sets
from tasks.painter.evaluate import score_painters
from tasks.painter.held_out_fits import HeldOutFit
from tasks.runs import open_run

PRECISIONS = (torch.float32, torch.bfloat16)


def evaluate_painters(
    painters: Sequence[Path],
    pair_folders: Sequence[Path],
    runs: Sequence[str] = (),
    *,
    feature_weights: Path | None = None,
    keep_below: float | None = None,
    device: Device = "auto",
) -> dict[str, Any]:
    """Judge painters on pairs and on views of runs that none of them was trained on.

    Raises:
        ConfigError: neither pairs nor runs to judge by.
    """
    if not pair_folders and not runs:
        raise ConfigError("nothing to judge by: expected --pairs or --run")
    return score_painters.fn(
        {str(painter): str(painter) for painter in painters},
        named_sets(pair_folders),
        [_first_fit(run) for run in runs],
        feature_weights=feature_weights,
        keep_below=keep_below,
        device=str(chosen_device(device)),
    )


def _first_fit(run: str) -> HeldOutFit:
    """The first fit of a finished run, and the views that it was not fitted to."""
    store = existing_store()
    finished = open_run(store, run)
    parameters = view_parameters(finished)
    return HeldOutFit(
        store_path=store.address,
        run_id=finished.run_id,
        split=parameters.split_spec,
        fitted=finished.unpainted,
        settings=parameters.evaluation_config,
    )


def describe(name: str) -> dict[str, Any]:
    """What a painter is, what it is made of and how it was trained."""
    choice = PainterChoice.of(name)
    found = describe_painter(choice.load(torch.device("cpu")))
    num_bytes = sum(path.stat().st_size for path in choice.files)
    return {"painter": name, "digest": choice.digest, "num_bytes": num_bytes, **found}


def benchmark_painter(
    name: str, size_px: tuple[int, int], repeats: int, device: Device = "auto"
) -> dict[str, Any]:
    """Time a view of that width and height, in float32 and bfloat16 if the painter is learned."""
    width_px, height_px = size_px
    choice, place = PainterChoice.of(name), chosen_device(device)
    chosen = None if choice.kind == "rule" else faster_type(place)
    rows = []
    for precision in PRECISIONS if chosen else (None,):
        painter = choice.load(place, precision)
        times = time_views(painter, height_px=height_px, width_px=width_px, repeats=repeats)
        rows.append(
            {
                "precision": precision and type_name(precision),
                "is_chosen": precision == chosen,
                **asdict(times),
            }
        )
    return {
        "painter": name,
        "size_px": [width_px, height_px],
        "device": str(place),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "threads": torch.get_num_threads(),
        "times": rows,
    }
