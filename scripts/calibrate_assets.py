"""Fit the numbers by which the score of a vehicle is predicted, and judge them on other streets.

    python scripts/judge_assets.py STORE RUN... --json judged.jsonl
    python scripts/calibrate_assets.py judged.jsonl

Prints the coefficients for `assets/expected_quality.py`, and how they fare on streets that they
were not fitted to: each street's vehicles are predicted by the others'.
"""

import argparse
import json
import sys
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from judge_assets import GOOD_IOU, GOOD_SCORE, Line
from scipy.stats import spearmanr
from torch import Tensor

from lidarpainter_models.assets.expected_quality import EVIDENCE, score_of

RIDGE = 20.0
"""Directions that say as much as the assumption that evidence beside the first tells nothing."""


def fitted(lines: list[Line]) -> Float[Tensor, " evidence"]:
    """Coefficients in dB of the PSNR of directions (ridge regression on centred evidence)."""
    evidence = torch.tensor([line["evidence"] for line in lines], dtype=torch.float64)
    true_db = torch.tensor([line["psnr_db"] for line in lines], dtype=torch.float64)
    middle, mean_db = evidence[:, 1:].mean(0), true_db.mean()
    deviation = evidence[:, 1:].std(0).clamp(min=1e-6)
    own = (evidence[:, 1:] - middle) / deviation
    square = own.T @ own + RIDGE * torch.eye(own.shape[1], dtype=torch.float64)
    slopes = torch.linalg.solve(square, own.T @ (true_db - mean_db)) / deviation
    return torch.cat([(mean_db - middle @ slopes)[None], slopes])


def by_car(lines: list[Line]) -> dict[str, list[Line]]:
    """The directions of each vehicle."""
    found: dict[str, list[Line]] = {}
    for line in lines:
        found.setdefault(line["car"], []).append(line)
    return found


def held_out(lines: list[Line]) -> list[tuple[float, float, float]]:
    """Score, true mean PSNR and mean IoU of each vehicle, predicted by the other streets."""
    found = []
    for scene in sorted({line["scene_id"] for line in lines}):
        coefficients = fitted([line for line in lines if line["scene_id"] != scene])
        for own in by_car([line for line in lines if line["scene_id"] == scene]).values():
            evidence = torch.tensor([line["evidence"] for line in own], dtype=torch.float64)
            score = score_of((evidence @ coefficients).float())
            found.append(
                (score, fmean(one["psnr_db"] for one in own), fmean(one["iou"] for one in own))
            )
    return found


def main() -> None:
    """Print what was fitted and what it is worth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("judged", type=Path)
    asked = parser.parse_args()
    text = asked.judged.read_text("utf-8")
    lines = [json.loads(line) for line in text.splitlines()]
    lines = [line for line in lines if line["evidence"] is not None]
    if len({line["scene_id"] for line in lines}) < 2:
        sys.exit(f"{asked.judged}: needs whole vehicles of two streets or more")
    for name, value in zip(EVIDENCE, fitted(lines).tolist(), strict=True):
        sys.stdout.write(f"{name:14s} {value:8.3f}\n")
    scores, true_db, ious = zip(*held_out(lines), strict=True)
    good = [iou for score, iou in zip(scores, ious, strict=True) if score >= GOOD_SCORE]
    sys.stdout.write(
        f"{len(scores)} vehicles, each street by the others: Spearman "
        f"{spearmanr(scores, true_db).statistic:.2f}; of {len(good)} with score {GOOD_SCORE} or "
        f"more, {sum(iou >= GOOD_IOU for iou in good)} have IoU {GOOD_IOU}\n"
    )


if __name__ == "__main__":
    main()
