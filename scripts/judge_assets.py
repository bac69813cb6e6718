"""Hold published vehicles of synthetic streets against the exact ones, from all around.

    python scripts/judge_assets.py STORE RUN... [--json FILE] [--sheet FOLDER]

Runs that are not published yet are published. Of each run those vehicles are judged that its
images show best. A direction is `seen` if an image shows the vehicle from within 30 degrees of its
azimuth, `mirrored` if one shows it so from the other side, and else `guessed`. PSNR is of the
pixels that the true vehicle covers, in the exposure of the recording; the floor is the box in the
mean colour of the asset. `--json` keeps a line for each vehicle and direction, by which
`calibrate_assets.py` fits the score; `--sheet` draws pictures: truth above, asset below.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Bool, Float
from scipy.stats import spearmanr
from torch import Tensor

from catalog.store import Store, open_store
from flows.assets import publish_run
from lidarpainter_models.assets.asset_files import ABOUT_FILE, read_asset
from lidarpainter_models.assets.expected_quality import directions
from lidarpainter_models.assets.sightings import box_view
from lidarpainter_models.assets.turntables import BACKGROUND, camera_around
from lidarpainter_models.editing.actor_models import (
    NEUTRAL_ROAD_RGB,
    ActorModel,
    exposed,
    exposure_gain,
)
from lidarpainter_models.export.images import write_png
from lidarpainter_models.gaussians.model.drawing import draw_gaussians
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.metrics.images import psnr_from_error
from lidarpainter_models.synthetic import SyntheticStreet
from lidarpainter_models.synthetic.lone_actors import LoneActor, LoneImage
from tasks.assets.publish import SIGHTINGS_FILE
from tasks.editing.donors import opened_world
from tasks.json_files import read_json
from tasks.opened import open_scene
from tasks.runs import open_run

VEHICLES = ("car", "van", "pickup")
MOST_OF_RUN = 8
LEAST_PIXELS_PER_M = 8.0
NEAR_DEG = 30.0
CLASSES = ("seen", "mirrored", "guessed")
GOOD_IOU, GOOD_SCORE = 0.8, 0.7
Line = dict[str, Any]


def direction_class(azimuth_deg: float, looks: list[list[float]]) -> str:
    """Whether a vehicle was seen from an azimuth, from its mirror image, or from neither."""

    def is_near(other_deg: float) -> bool:
        return any(abs((one[0] - other_deg + 180) % 360 - 180) <= NEAR_DEG for one in looks)

    return "seen" if is_near(azimuth_deg) else "mirrored" if is_near(-azimuth_deg) else "guessed"


def judged(
    model: ActorModel, truths: list[LoneImage], looks: list[list[float]]
) -> Iterator[tuple[Line, Float[Tensor, "height width 3"]]]:
    """Every direction: its numbers, and what the asset looks like from there."""
    weight = model.gaussians.opacity[:, None]
    mean_rgb = (model.gaussians.base_rgb * weight).sum(0) / weight.sum()
    for (azimuth, elevation), true in zip(directions().tolist(), truths, strict=True):
        camera = camera_around(azimuth, elevation, model.size_m)
        bodies = invert_rigid(camera.world_from_camera)[None].float()
        with torch.no_grad():
            drawn = draw_gaussians(model.gaussians, bodies, camera)
        rgb = (drawn.rgb.clamp(0, 1) + (1 - drawn.alpha[..., None]) * BACKGROUND).clamp(0, 1)
        line = {
            "azimuth_deg": round(math.degrees(azimuth), 3),
            "elevation_deg": round(math.degrees(elevation), 3),
            "class": direction_class(math.degrees(azimuth), looks),
            "iou": iou(drawn.alpha >= 0.5, true.is_covered),
            "psnr_db": psnr_db(rgb, true),
            "box_iou": iou(_box_mask(camera, model.size_m), true.is_covered),
            "box_psnr_db": psnr_db(mean_rgb.expand_as(rgb), true),
        }
        yield line, rgb


def iou(one: Bool[Tensor, "height width"], other: Bool[Tensor, "height width"]) -> float:
    """Intersection over union of two silhouettes."""
    return float((one & other).sum() / (one | other).sum().clamp(min=1))


def psnr_db(rgb: Float[Tensor, "height width 3"], true: LoneImage) -> float | None:
    """Of the pixels that the true actor covers; None where it covers none."""
    inside = true.is_covered
    if not bool(inside.any()):
        return None
    return psnr_from_error(max(float((rgb[inside] - true.rgb[inside]).square().mean()), 1e-10))


def _box_mask(camera: Camera, size_m: Float[Tensor, "3"]) -> Bool[Tensor, "height width"]:
    nothing = torch.zeros(camera.height_px, camera.width_px)
    mask = nothing.bool()
    view = box_view(camera, nothing, torch.eye(4), size_m)
    if view is not None:
        mask[view.row, view.column] = True
    return mask


def judge_run(store: Store, name: str, sheet: Path | None) -> Iterator[Line]:
    """Publish a run if need be, and judge its vehicles: a line for each direction."""
    published = publish_run(store, name)
    run = open_run(store, name)
    street = SyntheticStreet.from_manifest(open_scene(store, run.scene_id).manifest)
    road_rgb = opened_world(store, run).road_rgb
    gain = torch.ones(3)
    if road_rgb is not None:
        gain = 1 / exposure_gain(road_rgb, torch.tensor(NEUTRAL_ROAD_RGB))
    middle_ns = street.timestamps_ns[len(street.timestamps_ns) // 2]
    ids = [actor.actor_id for actor in street.actors(middle_ns)]
    for record in chosen(read_json(Path(published["artefact"]) / SIGHTINGS_FILE)):
        folder = Path(published["artefact"]) / record["folder"]
        about = json.loads((folder / ABOUT_FILE).read_text("utf-8"))
        model = read_asset(folder)
        model = ActorModel(
            gaussians=exposed(model.gaussians, gain),
            points=model.points,
            size_m=model.size_m,
            category=model.category,
        )
        lone = LoneActor(
            street=street, actor_index=ids.index(record["actor_id"]), timestamp_ns=middle_ns
        )
        truths = [lone.render(camera) for camera in cameras(model.size_m)]
        found = list(judged(model, truths, about["looks"]))
        kept = {key: record.get(key) for key in ("actor_id", "is_moving", "score")}
        kept |= {"scene_id": run.scene_id, "car": f"{run.scene_id} {record['actor_id']}"}
        known = about.get("evidence", [None] * len(found))
        for (line, _), evidence in zip(found, known, strict=True):
            if line["psnr_db"] is not None:
                yield {**kept, "evidence": evidence, "run_id": run.run_id, **line}
        if sheet is not None:
            write_png(
                picture_rows(truths, [[rgb for _, rgb in found]]),
                sheet / run.run_id / f"{record['actor_id']}.png",
            )


def cameras(size_m: Float[Tensor, "3"]) -> list[Camera]:
    """Cameras of all directions, in the box frame."""
    return [camera_around(azimuth, up, size_m) for azimuth, up in directions().tolist()]


def chosen(records: list[Line]) -> list[Line]:
    """The vehicles of a run that are judged: those shown largest and least hidden."""
    vehicles = [
        one
        for one in records
        if one["kind"] == "actor"
        and one["category"] in VEHICLES
        and one["pixels_per_m"] >= LEAST_PIXELS_PER_M
    ]
    vehicles.sort(key=lambda one: -one["pixels_per_m"] * (1 - one["occlusion"]))
    return vehicles[:MOST_OF_RUN]


def picture_rows(
    truths: list[LoneImage], found: list[list[Float[Tensor, "height width 3"]]]
) -> Float[Tensor, "rows columns 3"]:
    """Truth above, what was made of it below, row by row; every other azimuth."""
    grey = torch.tensor(BACKGROUND)
    above = [torch.where(one.is_covered[..., None], one.rgb, grey) for one in truths]
    picked = range(0, len(truths), 2)
    strips = [torch.cat([many[one] for one in picked], dim=1) for many in (above, *found)]
    return torch.cat(strips, dim=0)


def summary(lines: list[Line]) -> str:
    """The table: by class of direction the means over vehicles; and what the score is worth."""
    cars = sorted({line["car"] for line in lines})
    text = [f"{len(cars)} vehicles", "class      vehicles   IoU   PSNR   box IoU   box PSNR"]
    for kind in CLASSES:
        of_cars = [
            [one for one in lines if one["car"] == car and one["class"] == kind] for car in cars
        ]
        of_cars = [ones for ones in of_cars if ones]
        if of_cars:
            means = [
                fmean(fmean(one[key] for one in ones) for ones in of_cars)
                for key in ("iou", "psnr_db", "box_iou", "box_psnr_db")
            ]
            text.append(
                "{:10s} {:8d} {:.3f} {:6.2f}     {:.3f}   {:8.2f}".format(
                    kind, len(of_cars), *means
                )
            )
    own = {car: [one for one in lines if one["car"] == car] for car in cars}
    scores = [own[car][0]["score"] for car in cars]
    true_db = [fmean(one["psnr_db"] for one in own[car]) for car in cars]
    text.append(f"Spearman of score and true mean PSNR: {spearmanr(scores, true_db).statistic:.2f}")
    good = [car for car in cars if own[car][0]["score"] >= GOOD_SCORE]
    whole = sum(fmean(one["iou"] for one in own[car]) >= GOOD_IOU for car in good)
    text.append(f"of {len(good)} with score {GOOD_SCORE} or more, {whole} have IoU {GOOD_IOU}")
    return "\n".join(text)


def main() -> None:
    """Judge the runs that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("store", type=Path)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--sheet", type=Path)
    asked = parser.parse_args()
    store = open_store(asked.store)
    lines = [line for run in asked.runs for line in judge_run(store, run, asked.sheet)]
    if asked.json is not None:
        asked.json.write_text("".join(json.dumps(line) + "\n" for line in lines))
    sys.stdout.write(summary(lines) + "\n")


if __name__ == "__main__":
    main()
