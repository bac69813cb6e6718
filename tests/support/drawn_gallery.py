"""A gallery of thousands of drawn cars, as large as what a fleet yields."""

import cv2
import numpy as np
from asset_rows import asset_rows

from lidarpainter_models.export.gallery import write_gallery

NUM_AZIMUTHS, WIDTH_PX, HEIGHT_PX = 8, 128, 96
NUM_STRIPS = 16
"""Different ones; each asset has a file of its own."""


def write_drawn_gallery(folder, strips, count, **first):
    """A gallery of assets, the first of which has other values; returns its page."""
    strips.mkdir(exist_ok=True)
    paths = [strips / f"{number}.webp" for number in range(NUM_STRIPS)]
    for number, path in enumerate(paths):
        cv2.imwrite(str(path), drawn_strip(number), [cv2.IMWRITE_WEBP_QUALITY, 80])
    rows = asset_rows(count).to_pylist()
    rows[0] |= first
    picture_of = {row["asset_id"]: paths[at % NUM_STRIPS] for at, row in enumerate(rows)}
    write_gallery(folder, rows, lambda row: picture_of[row["asset_id"]])
    return folder / "index.html"


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
