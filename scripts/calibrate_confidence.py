"""Make the numbers behind the confidence of frames, and judge them on other streets.

    python scripts/calibrate_confidence.py measure STORE 101:108 > tuned.jsonl
    python scripts/calibrate_confidence.py measure STORE 201:206 60 >> tuned.jsonl
    python scripts/calibrate_confidence.py fit tuned.jsonl
    python scripts/calibrate_confidence.py measure STORE 301:305 40 > unseen.jsonl
    python scripts/calibrate_confidence.py judge unseen.jsonl
    python scripts/calibrate_confidence.py envelope STORE 301:305
    python scripts/calibrate_confidence.py recorded STORE RUN... > logs.jsonl

`measure` records synthetic streets of these seeds (cameras, beams and effort follow from the seed,
so that bad frames occur), reconstructs them with preset `brief`, and draws frames of the first fit
and of the last one from anywhere around the path: a line each, with the evidence and the true
PSNR. `fit` prints the numbers for `evaluation/view_confidence.py`; `judge` holds those that are
there against frames; `envelope` draws frames inside the envelopes and counts who keeps the promise;
`recorded` prints the held-out frames of finished runs of any log, for `judge`.
"""

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

import torch

from catalog.store import Store, open_store
from flows.overrides import with_overrides
from flows.parameters import ReconstructParameters, view_parameters
from flows.presets import brief
from flows.reconstruct import reconstruct
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer, ViewEvidence
from lidarpainter_models.evaluation.confidence_trials import trials, true_psnr_db
from lidarpainter_models.evaluation.envelope import DIRECTIONS, MovedViews, trust_envelope
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_confidence import (
    BUNDLED,
    EVIDENCE,
    GOOD_DB,
    NUM_BINS,
    PROMISED,
    calibrated,
    expected_calibration_error,
)
from lidarpainter_models.metrics.images import psnr_from_error, squared_error
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.synthetic import RigLidar, SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.ingest.ingest import ingest_street
from tasks.opened import open_scene, open_split
from tasks.runs import open_run
from tasks.specs import FittedRef, street_id
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


def fits_of(store: Store, seed: int) -> Iterator[tuple[str, MovedViews]]:
    """The first fit and the last one of a street, made where they are not there."""
    if street_id(seed) not in store.scene_ids():
        ingest_street.fn(store.address, street_of(seed))
    result = reconstruct(parameters_of(seed), store.address)
    run = open_run(store, result["run_id"])
    for name, fitted in (("first", run.unpainted), ("last", run.final)):
        observation = view_parameters(run).observation
        yield name, moved_views(store, street_id(seed), fitted, observation)


def moved_views(
    store: Store, scene_id: str, fitted: FittedRef, observation: ObservationConfig
) -> MovedViews:
    """A scene fitted to images of that size, to be looked at from anywhere."""
    seen = load_observations(store, fitted.observations)
    scene = load_scene(store, fitted.gaussians)
    return MovedViews(
        scene=open_scene(store, scene_id),
        gatherer=EvidenceGatherer(scene, seen.lidar_map, seen.views),
        observation=observation,
    )


def measure(store_path: str, seeds: str, frames: str = "30") -> None:
    """Print a line for every frame that was drawn: so many of each fit."""
    store, count = open_store(Path(store_path)), int(frames)
    for seed in seeds_of(seeds):
        for fit, views in fits_of(store, seed):
            began_s = time.process_time()
            for trial in trials(views, CAMERA, count, seed=seed):
                row = {"street": street_id(seed), "fit": fit, **asdict(trial)}
                sys.stdout.write(json.dumps(row) + "\n")
            sys.stdout.flush()
            seconds = (time.process_time() - began_s) / count
            sys.stderr.write(f"{street_id(seed)} {fit}: {seconds:.3f} CPU s a frame\n")


def recorded(store_path: str, *run_ids: str) -> None:
    """Print a line for every held-out frame of some runs, of the first fit and of the last one."""
    store = open_store(Path(store_path))
    for run_id in run_ids:
        run = open_run(store, run_id)
        parameters = view_parameters(run)
        _scene, split = open_split(store, parameters.split_spec)
        for fit, fitted in (("first", run.unpainted), ("last", run.final)):
            views = moved_views(store, run.scene_id, fitted, parameters.observation)
            scene, gatherer = views.gatherer.scene, views.gatherer
            held_out = HeldOut(
                scene=views.scene, test_views=split.test, observation=views.observation
            )
            for view in held_out.recorded_views(scene, "interpolated"):
                name = view.name.partition("/")[0]
                shown = scene.render(view.camera, view.timestamp_ns, camera_name=name).rgb
                error = squared_error(shown, view.truth_rgb)
                error = error if view.hidden is None else error[~view.hidden]
                row = {
                    "street": run.scene_id,
                    "fit": fit,
                    "frame": view.name,
                    "evidence": asdict(gatherer.of(view.camera, view.timestamp_ns, name)),
                    "psnr_db": psnr_from_error(float(error.mean())),
                }
                sys.stdout.write(json.dumps(row) + "\n")


def fit(*files: str) -> None:
    """Print the numbers that these frames give."""
    rows = read(files)
    found = calibrated(
        [evidence_of(row) for row in rows],
        [row["psnr_db"] for row in rows],
        [row["street"] for row in rows],
        names=EVIDENCE,
        record="",
    )
    sys.stdout.write(json.dumps(asdict(found), indent=2) + "\n")
    told(rows, [found.of(evidence_of(row)).confidence for row in rows])


def judge(*files: str) -> None:
    """Hold the bundled numbers against these frames."""
    rows = read(files)
    said = [BUNDLED.of(evidence_of(row)) for row in rows]
    told(rows, [one.confidence for one in said])
    off = [abs(one.predicted_db - row["psnr_db"]) for one, row in zip(said, rows, strict=True)]
    sys.stdout.write(f"mean error of the predicted PSNR {fmean(off):.2f} dB\n")


def told(rows: list[dict], confidences: list[float]) -> None:
    """How calibrated these confidences are."""
    good = [row["psnr_db"] >= GOOD_DB for row in rows]
    kept = [one for one, said in zip(good, confidences, strict=True) if said >= PROMISED]
    error = expected_calibration_error(confidences, good)
    sys.stdout.write(
        f"{len(rows)} frames of {len({row['street'] for row in rows})} streets, "
        f"{share(good):.3f} of them good; promised {len(kept)}, kept {share(kept):.3f}; "
        f"expected calibration error {error:.3f}\n"
    )
    for low in range(NUM_BINS):
        inside = [
            (said, one)
            for said, one in zip(confidences, good, strict=True)
            if min(int(said * NUM_BINS), NUM_BINS - 1) == low
        ]
        if inside:
            said_mean, true_share = (fmean(column) for column in zip(*inside, strict=True))
            sys.stdout.write(f"  {len(inside):4d} said {said_mean:.2f}, good {true_share:.2f}\n")


def envelope(store_path: str, seeds: str) -> None:
    """Draw frames inside the envelopes of the last fits and count who keeps the promise."""
    store, everything = open_store(Path(store_path)), []
    generator = torch.Generator().manual_seed(0)
    for seed in seeds_of(seeds):
        *_, (_name, views) = fits_of(store, seed)
        began_s = time.process_time()
        found = trust_envelope(views, [CAMERA], BUNDLED)
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


def seeds_of(text: str) -> range:
    """`101:113`, the end excluded."""
    first, _, end = text.partition(":")
    return range(int(first), int(end or int(first) + 1))


COMMANDS = {
    "measure": measure,
    "fit": fit,
    "judge": judge,
    "envelope": envelope,
    "recorded": recorded,
}

if __name__ == "__main__":
    COMMANDS[sys.argv[1]](*sys.argv[2:])
