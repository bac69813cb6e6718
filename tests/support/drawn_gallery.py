"""A gallery of thousands of drawn cars, as large as what a fleet yields."""

import hashlib

import cv2
import numpy as np

from lidarpainter_models.export.gallery import write_gallery

NUM_AZIMUTHS, WIDTH_PX, HEIGHT_PX = 8, 128, 96
NUM_STRIPS = 16
"""Different ones; each asset has a file of its own."""
ACTORS_A_SCENE = 50
SIDES = ("front", "rear", "left", "right", "top")
DATASETS = (("pandaset", "Car"), ("nuscenes", "vehicle.car"), ("synthetic", "car"))
OTHERS = ("Pedestrian", "Bus", "Medium-sized Truck", "Bicycle", "Pickup Truck")
STYLES = (None, "night", "foggy", "rain")


def write_drawn_gallery(folder, strips, count, **first):
    """A gallery of assets, the first of which has other values; returns its page."""
    strips.mkdir(exist_ok=True)
    paths = [strips / f"{number}.webp" for number in range(NUM_STRIPS)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), drawn_strip(number), [cv2.IMWRITE_WEBP_QUALITY, 80])
    rng = np.random.default_rng(0)
    rows = [drawn_asset(number, rng) for number in range(count)]
    rows[0] |= first
    picture_of = {row["asset_id"]: paths[at % NUM_STRIPS] for at, row in enumerate(rows)}
    write_gallery(folder, rows, lambda row: picture_of[row["asset_id"]])
    return folder / "index.html"


def drawn_asset(number, rng):
    """An actor as logs of many scenes yield it: six of ten are cars."""
    scene, track = divmod(number, ACTORS_A_SCENE)
    dataset, car = DATASETS[scene % len(DATASETS)]
    category = car if rng.random() < 0.6 else str(rng.choice(OTHERS))
    return {
        "asset_id": hashlib.sha256(str(number).encode()).hexdigest()[:16],
        "kind": "actor",
        "category": category,
        "name": f"{category} {number}",
        "dataset": dataset,
        "licence": "CC BY 4.0",
        "style": STYLES[rng.integers(len(STYLES))],
        "actor_id": f"track-{track}",
        "run_id": f"{scene:016x}",
        "scene_ids": [f"{dataset}/{scene:05d}"],
        **dict(zip(("length_m", "width_m", "height_m"), rng.uniform(0.5, 6, 3), strict=True)),
        "sides": [side for side in SIDES if rng.random() < 0.55],
        "coverage": rng.random(),
        "score": rng.random(),
        "psnr_db": rng.uniform(15, 35),
        "lpips": None if rng.random() < 0.2 else rng.uniform(0, 0.4),
        "num_views": int(rng.integers(1, 200)),
        "num_points": int(rng.integers(50_000)),
        "num_gaussians": int(rng.integers(100, 20_000)),
        "num_sightings": int(rng.integers(1, 4)),
    }


def drawn_strip(number):
    """A car on a turntable, azimuths side by side."""
    paint = np.random.default_rng(number).integers(40, 220, 3).tolist()
    strip = np.full((HEIGHT_PX, NUM_AZIMUTHS * WIDTH_PX, 3), 191, np.uint8)
    for azimuth in range(NUM_AZIMUTHS):
        middle = azimuth * WIDTH_PX + WIDTH_PX // 2
        half = 26 + int(22 * abs(np.sin(2 * np.pi * azimuth / NUM_AZIMUTHS)))
        cv2.rectangle(strip, (middle - half, 45), (middle + half, 72), paint, -1)
        cv2.rectangle(strip, (middle - half // 2, 28), (middle + half // 2, 45), paint, -1)
    return strip
