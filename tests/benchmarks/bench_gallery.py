"""How soon a gallery of drawn assets opens, scrolls and filters, in Chromium without a screen.

    PYTHONPATH=.:tests/support python tests/benchmarks/bench_gallery.py [ASSETS] [RUNS]

Wall seconds from asking for the page to the first picture, and from a jump to the last row until
it is drawn; milliseconds of the script for one filter.
"""

import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from chromium import NO_WEBGL, Chromium, until
from drawn_gallery import write_drawn_gallery

HAS_PICTURE = "[...document.querySelectorAll('.stage img')].some(one => one.naturalWidth)"
HAS_LAST = """(() => {
    const last = [...document.querySelectorAll('.card')].at(-1);
    return last.getBoundingClientRect().bottom <= innerHeight
        && last.querySelector('img').naturalWidth > 0;
})()"""
FILTER_MS = """(() => {
    const start = performance.now();
    document.querySelector('#category button').click();
    return performance.now() - start;
})()"""


def opened(page, width_px):
    """First picture and last row in seconds, a filter in milliseconds, of one new browser."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        Chromium(Path(folder), width_px=width_px, height_px=850, words=NO_WEBGL) as browser,
    ):
        started = time.perf_counter()
        browser.open(page.as_uri())
        until(lambda: browser.value(HAS_PICTURE))
        first_s = time.perf_counter() - started
        started = time.perf_counter()
        browser.value("scrollTo(0, 1e9)")
        until(lambda: browser.value(HAS_LAST))
        return first_s, time.perf_counter() - started, browser.value(FILTER_MS)


def main(count: int = 10_000, runs: int = 5) -> None:
    """Print medians for a desk and a phone."""
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        page = write_drawn_gallery(Path(folder) / "gallery", Path(folder) / "strips", count)
        num_bytes = sum(one.stat().st_size for one in page.parent.rglob("*") if one.is_file())
        written_s = time.perf_counter() - started
        sys.stdout.write(
            f"{count} assets: written in {written_s:.1f} s, {num_bytes / 1e6:.0f} MB\n"
        )
        for width_px in (1400, 400):
            times = zip(*(opened(page, width_px) for _ in range(runs)), strict=True)
            first_s, last_s, filter_ms = map(median, times)
            sys.stdout.write(
                f"{width_px} px wide: first picture after {first_s:.2f} s, last row after "
                f"{last_s:.2f} s, a filter in {filter_ms:.0f} ms (medians of {runs})\n"
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
