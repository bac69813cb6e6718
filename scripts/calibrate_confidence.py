"""Make the numbers behind the confidence of frames, and judge them on other streets.

    python scripts/calibrate_confidence.py measure STORE 101:108 > tuned.jsonl
    python scripts/calibrate_confidence.py measure STORE 201:206 60 >> tuned.jsonl
    python scripts/calibrate_confidence.py fit tuned.jsonl
    python scripts/calibrate_confidence.py measure STORE 301:305 40 > unseen.jsonl
    python scripts/calibrate_confidence.py recorded STORE RUN... > logs.jsonl
    python scripts/calibrate_confidence.py judge unseen.jsonl logs.jsonl
    python scripts/calibrate_confidence.py envelope STORE 301:305

`measure` records synthetic streets of these seeds (cameras, beams and effort follow from the seed,
so that bad frames occur), reconstructs them with preset `brief`, and draws frames of the first fit
and of the last one from anywhere around the path: a line each, with the evidence and the true
PSNR. Held-out frames on the path are printed too, and `recorded` prints those of finished runs of
any log. `fit` prints the numbers for `evaluation/view_confidence.py`; `judge` holds those that are
there against frames, as they are and anchored on other frames of the same log; `envelope` draws
frames inside the envelopes and counts who keeps the promise.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from confidence_fit import EVIDENCE, NUM_BINS, calibrated, expected_calibration_error
from confidence_trials import trials, true_psnr_db

from catalog.store import Store, open_store
from flows.overrides import with_overrides
from flows.parameters import ReconstructParameters, view_parameters
from flows.presets import brief
from flows.reconstruct import reconstruct
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer, ViewEvidence
from lidarpainter_models.evaluation.anchoring import (
    MOST_VIEWS,
    judged_frames,
    predicted_and_measured,
    what_frames_say,
)
from lidarpainter_models.evaluation.envelope import DIRECTIONS, MovedViews, trust_envelope
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_confidence import (
    BUNDLED,
    GOOD_DB,
    Calibration,
)
from lidarpainter_models.scenes.splits import evenly_taken
from lidarpainter_models.synthetic import RigLidar, SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.ingest.ingest import ingest_street
from tasks.opened import open_split
from tasks.runs import FinishedRun, open_run
from tasks.specs import street_id
from tasks.stored import load_observations, load_scene

INSIDE_EACH = 4
"""Frames drawn in each direction of each stretch of an envelope."""
WIDTHS_PX = (160, 160, 240, 160, 160, 320)
BEAMS = (64, 64, 16, 64, 8, 64, 32)
LOOKS = (375.0, 375.0, 90.0, 375.0, 190.0)
"""Effort of the first fit; that of the preset is 375."""
CAMERA = DEFAULT_CAMERAS[0].name


def street_of(seed: int) -> SyntheticStreetConfig:
    """What is recorded."""
    width_px = WIDTHS_PX[seed % len(WIDTHS_PX)]
    return SyntheticStreetConfig(
        seed=seed,
        num_frames=20,
        width_px=width_px,
        height_px=width_px * 9 // 16,
        cameras=DEFAULT_CAMERAS[:1],
        lidar=RigLidar(beams=BEAMS[seed % len(BEAMS)]),
    )


def parameters_of(seed: int) -> ReconstructParameters:
    """How it is reconstructed."""
    settings = [
        f"observation.width_px={street_of(seed).width_px}",
        f"fit.effort.looks={LOOKS[seed % len(LOOKS)]}",
        "judge=false",
        "report=false",
    ]
    return with_overrides(brief(street_id(seed)), settings)


def street_run(store: Store, seed: int) -> FinishedRun:
    """The run of a street, made where it is not there."""
    if street_id(seed) not in store.scene_ids():
        ingest_street.fn(store.address, street_of(seed))
    return open_run(store, reconstruct(parameters_of(seed), store.address)["run_id"])


def fits_of(store: Store, run: FinishedRun) -> Iterator[tuple[str, MovedViews, HeldOut]]:
    """The first fit of a run and the last one, to be looked at from anywhere, and what judges."""
    parameters = view_parameters(run)
    scene, split = open_split(store, parameters.split_spec)
    size = parameters.observation
    held_out = HeldOut(scene=scene, test_views=split.test, observation=size)
    for name, fitted in (("first", run.unpainted), ("last", run.final)):
        seen = load_observations(store, fitted.observations)
        gatherer = EvidenceGatherer(load_scene(store, fitted.gaussians), seen.lidar_map, seen.views)
        yield name, MovedViews(scene=scene, gatherer=gatherer, observation=size), held_out


def measure(store_path: str, seeds: str, frames: str = "30") -> None:
    """Print a line for every frame that was drawn, so many of each fit, and for those held out."""
    store, count = open_store(Path(store_path)), int(frames)
    for seed in seeds_of(seeds):
        run = street_run(store, seed)
        for fit, views, held_out in fits_of(store, run):
            for frame in judged_frames(held_out, views.gatherer):
                printed(run.scene_id, fit, asdict(frame))
            began_s = time.process_time()
            for trial in trials(views, CAMERA, count, seed=seed):
                printed(street_id(seed), fit, asdict(trial))
            seconds = (time.process_time() - began_s) / count
            sys.stderr.write(f"{street_id(seed)} {fit}: {seconds:.3f} CPU s a frame\n")


def recorded(store_path: str, *run_ids: str) -> None:
    """Print a line for every held-out frame of some runs, of the first fit and of the last one."""
    store = open_store(Path(store_path))
    for run_id in run_ids:
        run = open_run(store, run_id)
        for fit, views, held_out in fits_of(store, run):
            for frame in judged_frames(held_out, views.gatherer):
                printed(run.scene_id, fit, asdict(frame))


def printed(scene_id: str, fit: str, found: dict[str, Any]) -> None:
    """One line of a frame."""
    sys.stdout.write(json.dumps({"street": scene_id, "fit": fit, **found}) + "\n")
    sys.stdout.flush()


def fit(*files: str) -> None:
    """Print the numbers that these frames give; held-out ones do not count."""
    rows = [row for row in read(files) if not is_held_out(row)]
    found = calibrated(
        [evidence_of(row) for row in rows],
        [row["psnr_db"] for row in rows],
        [row["street"] for row in rows],
        names=EVIDENCE,
        record="",
    )
    sys.stdout.write(json.dumps(asdict(found), indent=2) + "\n")
    told(rows, [found] * len(rows))


def judge(*files: str) -> None:
    """Hold the bundled numbers against these frames: as they are, unchecked, and anchored.

    Anchored on every second held-out frame of a log, they are held against the others; on all
    held-out frames of a street, against the frames that were drawn.
    """
    rows = read(files)
    logs: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        logs.setdefault((row["street"], row["fit"]), []).append(row)
    ways: dict[str, list[Calibration]] = {"as calibrated": [], "not checked": [], "anchored": []}
    judged: list[dict] = []
    for (street, name), own in logs.items():
        held_out = sorted(filter(is_held_out, own), key=lambda row: row["name"].partition("/")[0])
        drawn = [row for row in own if not is_held_out(row)]
        for kind, anchors, others in (
            ("on the path", held_out[::2], held_out[1::2]),
            ("drawn", held_out, drawn),
        ):
            if not others:
                continue
            known = [
                (predicted_db(row), row["psnr_db"]) for row in evenly_taken(anchors, MOST_VIEWS)
            ]
            off = fmean(row["psnr_db"] - predicted_db(row) for row in others)
            sys.stdout.write(
                f"{street}, {name} fit, {kind}: {off:+.2f} dB from predicted, "
                f"anchored on {json.dumps(what_frames_say(known))}\n"
            )
            judged += others
            numbers = (BUNDLED, BUNDLED.anchored(()), BUNDLED.anchored(known))
            for way, calibration in zip(ways, numbers, strict=True):
                ways[way] += [calibration] * len(others)
                sys.stdout.write(f"  {way}: ")
                told(others, [calibration] * len(others))
    for way, calibrations in ways.items():
        sys.stdout.write(f"all, {way}: ")
        told(judged, calibrations, with_bins=True)


def told(rows: list[dict], calibrations: list[Calibration], *, with_bins: bool = False) -> None:
    """How well numbers, those of each row, say what becomes of frames."""
    pairs = zip(rows, calibrations, strict=True)
    said = [calibration.of(evidence_of(row)) for row, calibration in pairs]
    good = [row["psnr_db"] >= GOOD_DB for row in rows]
    kept = [is_good for is_good, one in zip(good, said, strict=True) if one.is_promised]
    off = [abs(one.predicted_db - row["psnr_db"]) for one, row in zip(said, rows, strict=True)]
    confidences = [one.confidence for one in said]
    sys.stdout.write(
        f"{len(rows)} frames of {len({row['street'] for row in rows})} logs, {share(good):.3f} of "
        f"them good; promised {len(kept)}, kept {share(kept):.3f}; expected calibration error "
        f"{expected_calibration_error(confidences, good):.3f}; mean error of the predicted PSNR "
        f"{fmean(off):.2f} dB\n"
    )
    for low in range(NUM_BINS if with_bins else 0):
        inside = [
            (one, is_good)
            for one, is_good in zip(confidences, good, strict=True)
            if min(int(one * NUM_BINS), NUM_BINS - 1) == low
        ]
        if inside:
            said_mean, true_share = (fmean(column) for column in zip(*inside, strict=True))
            sys.stdout.write(f"  {len(inside):4d} said {said_mean:.2f}, good {true_share:.2f}\n")


def envelope(store_path: str, seeds: str) -> None:
    """Draw frames inside the envelopes of the last fits and count who keeps the promise."""
    store, everything = open_store(Path(store_path)), []
    generator = torch.Generator().manual_seed(0)
    for seed in seeds_of(seeds):
        *_, (_name, views, held_out) = fits_of(store, street_run(store, seed))
        began_s = time.process_time()
        frames = judged_frames(held_out.sampled(MOST_VIEWS), views.gatherer)
        calibration = BUNDLED.anchored(predicted_and_measured(frames))
        found = trust_envelope(views, [CAMERA], calibration)
        seconds = time.process_time() - began_s
        psnr_db = [db for row in found["stretches"] for db in inside(views, row, generator)]
        everything += psnr_db
        kept = share([db >= GOOD_DB for db in psnr_db])
        sys.stdout.write(
            f"{street_id(seed)}: {found['num_frames']} frames in {seconds:.1f} CPU s; of "
            f"{len(psnr_db)} drawn inside {kept:.3f} good\n"
        )
        for row in found["stretches"]:
            said = {name: row[name] for name in DIRECTIONS}
            sys.stdout.write(f"  {row['from_m']:.0f}-{row['to_m']:.0f} m: {json.dumps(said)}\n")
    good = [db >= GOOD_DB for db in everything]
    sys.stdout.write(f"all: {len(good)} frames inside, {share(good):.3f} good\n")


def inside(views: MovedViews, row: dict, generator: torch.Generator) -> list[float]:
    """PSNR of frames drawn inside a stretch's envelope."""
    recorded = [
        view
        for view in views.scene.views_of(CAMERA)
        if row["first_frame"] <= view.frame_index <= row["last_frame"]
    ]
    found = []
    for name, (_levels, step_of) in DIRECTIONS.items():
        for _ in range(INSIDE_EACH if row[name] else 0):
            part, place = torch.rand(2, generator=generator).tolist()
            view = recorded[min(int(place * len(recorded)), len(recorded) - 1)]
            camera = views.camera(view, step_of(row[name] * part))
            if camera is not None:
                found.append(true_psnr_db(views, camera, view))
    return found


def share(good: list[bool]) -> float:
    """How many of them are; not a number where there is none."""
    return fmean(good) if good else float("nan")


def read(files: tuple[str, ...]) -> list[dict]:
    """The lines of some files."""
    return [json.loads(line) for name in files for line in Path(name).read_text().splitlines()]


def evidence_of(row: dict) -> ViewEvidence:
    """What was measured of a frame."""
    return ViewEvidence(**{name: row["evidence"][name] for name in EVIDENCE})


def is_held_out(row: dict) -> bool:
    """Whether a frame is one of the log's own, not drawn beside its path."""
    return "name" in row


def predicted_db(row: dict) -> float:
    """PSNR of a frame by the bundled numbers."""
    return BUNDLED.of(evidence_of(row)).predicted_db


def seeds_of(text: str) -> range:
    """`101:113`, the end excluded."""
    first, _, end = text.partition(":")
    return range(int(first), int(end or int(first) + 1))


COMMANDS: dict[str, Callable[..., None]] = {
    "measure": measure,
    "fit": fit,
    "judge": judge,
    "envelope": envelope,
    "recorded": recorded,
}

if __name__ == "__main__":
    COMMANDS[sys.argv[1]](*sys.argv[2:])
