"""How soon an exported page shows its first image, in Chromium without a screen or a GPU.

    PYTHONPATH=tests/support python tests/benchmarks/bench_page.py drive.html [RUNS]

Seconds from asking for the page to the first drawn canvas that is not of one colour.
"""

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from chromium import Chromium, until

WIDTH_PX, HEIGHT_PX = 960, 540


def first_image_s(page: Path) -> float:
    """Of one new browser."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        Chromium(Path(folder), width_px=WIDTH_PX, height_px=HEIGHT_PX) as browser,
    ):
        started = time.perf_counter()
        browser.open(page.as_uri())
        until(lambda: (rgb := browser.canvas_rgb()) is not None and rgb.std() > 0.05)
        return time.perf_counter() - started


def main(page: Path, runs: int = 5) -> None:
    """Print every time and their median."""
    times = [first_image_s(page.resolve()) for _ in range(runs)]
    shown = ", ".join(f"{seconds:.1f}" for seconds in times)
    sys.stdout.write(f"first image after {median(times):.1f} s (median of {shown})\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:3]))
