"""Hold vehicles fused from two sequences against the exact ones, beside the sightings alone.

    python scripts/returning_street.py STORE SEED...
    lidarpainter --store STORE reconstruct synthetic/street-SEED ...     (and street-1SEED)
    python scripts/judge_fusion.py STORE SEED... [--sheet FOLDER]

Publishes the newest runs of both ways through each street, and judges every vehicle that both show
whole, all around (24 directions, as `judge_assets.py` does): the PSNR of the pixels that the true
one covers and the IoU of its silhouette, means over directions; in the exposure of the recording,
of the fused one in the mean of both. `--sheet` draws truth, both sightings and the fused one.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from judge_assets import cameras, judged, picture_rows
from returning_street import BACK, ReturningStreet
from torch import Tensor

from catalog.artefacts import ArtefactRef
from catalog.store import Store, open_store
from catalog.tables import Row
from flows.assets import publish_run
from lidarpainter_models.assets.asset_files import read_asset
from lidarpainter_models.editing.actor_models import NEUTRAL_ROAD_RGB, exposed, exposure_gain
from lidarpainter_models.export.images import write_png
from lidarpainter_models.synthetic.lone_actors import LoneActor, LoneImage
from tasks.editing.donors import opened_world
from tasks.opened import open_scene
from tasks.runs import open_run

FUSED = "fused"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One vehicle: its mean PSNR and IoU as both ways show it, the better first, and fused."""

    car: str
    psnr_db: tuple[float, float, float]
    iou: tuple[float, float, float]
    scores: tuple[float, float, float]

    @property
    def is_better(self) -> bool:
        """Whether the fused one is better than either."""
        return self.psnr_db[2] > max(self.psnr_db[:2])


def judge_street(store: Store, seed: int, sheet: Path | None) -> list[Verdict]:
    """Publish both ways through a street, and judge the vehicles that both show."""
    scenes = [f"synthetic/street-{number:04d}" for number in (seed, seed + BACK)]
    runs = [open_run(store, scene) for scene in scenes]
    for run in runs:
        publish_run(store, run.run_id)
    street = ReturningStreet.from_manifest(open_scene(store, scenes[0]).manifest)
    gains = {run.run_id: _true_gain(store, run.run_id) for run in runs}
    gains[FUSED] = torch.stack(list(gains.values())).log().mean(0).exp()
    middle_ns = street.timestamps_ns[len(street.timestamps_ns) // 2]
    ids = [actor.actor_id for actor in street.actors(middle_ns)]
    known = store.tables.rows("sightings", where={"actor_id": set(ids)})
    found = []
    for index, name in enumerate(ids):
        rows = {
            _of(row): row for row in known if row["actor_id"] == name and row["kind"] == "actor"
        }
        if FUSED not in rows or any(run.run_id not in rows for run in runs):
            continue
        lone = LoneActor(street=street, actor_index=index, timestamp_ns=middle_ns)
        own = sorted((rows[run.run_id] for run in runs), key=lambda row: -(row["score"] or 0))
        verdict, pictures = _judged(store, lone, [*own, rows[FUSED]], gains)
        found.append(replace(verdict, car=name))
        if sheet is not None:
            write_png(pictures, sheet / f"{name}.png")
    return found


def _of(row: Row) -> str:
    return FUSED if row["fused_from"] else str(row["run_id"])


def _true_gain(store: Store, run_id: str) -> Float[Tensor, "3"]:
    """What brings neutral colours of a run back to those of the street itself."""
    run = open_run(store, run_id)
    (camera,) = open_scene(store, run.scene_id).manifest["generator"]["config"]["cameras"]
    road_rgb = opened_world(store, run).road_rgb
    if road_rgb is None:
        sys.exit(f"run {run_id} shows no road, by which its exposure is told")
    neutral = exposure_gain(road_rgb, torch.tensor(NEUTRAL_ROAD_RGB))
    return 1 / (neutral * float(camera["gain"]))


def _judged(
    store: Store, lone: LoneActor, rows: list[Row], gains: dict[str, Float[Tensor, "3"]]
) -> tuple[Verdict, Float[Tensor, "height width 3"]]:
    """Judge what was published of a vehicle; the pictures have the truth above."""
    psnr, iou, pictures = [], [], []
    truths: list[LoneImage] = []
    for row in rows:
        artefact = store.artefacts.folder(ArtefactRef.of_id(row["artefact_id"]))
        model = read_asset(artefact / row["folder"])
        model = replace(model, gaussians=exposed(model.gaussians, gains[_of(row)]))
        truths = truths or [lone.render(camera) for camera in cameras(model.size_m)]
        found = list(judged(model, truths, []))
        seen = [line for line, _ in found if line["psnr_db"] is not None]
        psnr.append(fmean(line["psnr_db"] for line in seen))
        iou.append(fmean(line["iou"] for line in seen))
        pictures.append([rgb for _, rgb in found])
    one, other, both = (row["score"] for row in rows)
    verdict = Verdict(
        car="",
        psnr_db=(psnr[0], psnr[1], psnr[2]),
        iou=(iou[0], iou[1], iou[2]),
        scores=(one, other, both),
    )
    return verdict, picture_rows(truths, pictures)


def table(found: list[Verdict]) -> str:
    """A line for each vehicle, then the means."""
    text = [
        "vehicle                  PSNR: better  other   fused    IoU: better other fused   served"
    ]
    for one in found:
        numbers = "{:12.2f} {:6.2f}  {:6.2f}        {:.3f} {:.3f} {:.3f}".format(
            *one.psnr_db, *one.iou
        )
        served = FUSED if one.scores[2] > max(one.scores[:2]) else "one"
        text.append(f"{one.car:25s}{numbers}   {served}{'' if one.is_better else '  (not better)'}")
    means = [fmean(one.psnr_db[place] for one in found) for place in range(3)]
    means += [fmean(one.iou[place] for one in found) for place in range(3)]
    text.append(
        "{:25s}{:12.2f} {:6.2f}  {:6.2f}        {:.3f} {:.3f} {:.3f}".format("mean", *means)
    )
    best = fmean(max(one.psnr_db[:2]) for one in found)
    better = sum(one.is_better for one in found)
    text.append(
        f"the truly better of both: {best:.2f} dB; fused is better than either on {better} of "
        f"{len(found)}"
    )
    return "\n".join(text)


def main() -> None:
    """Judge the streets that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("seeds", nargs="+", type=int)
    parser.add_argument("--sheet", type=Path)
    asked = parser.parse_args()
    store = open_store(asked.store)
    found = [one for seed in asked.seeds for one in judge_street(store, seed, asked.sheet)]
    sys.stdout.write((table(found) if found else "no vehicle was fused") + "\n")


if __name__ == "__main__":
    main()
