"""How tables are laid out and what their columns are called: words, units, which way is better."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

Side = Literal["left", "right"]
ABSENT = "-"
GAP = "  "
"""What stands between two columns."""
LEAST_TEXT = 12
"""Characters of a column of text that is made narrower."""
PSNR, SSIM, LPIPS = "PSNR, dB, higher is better", "SSIM, higher is better", "LPIPS, lower is better"

HEADINGS = {
    "run_id": "run",
    "scene_id": "scene",
    "scene_ids": "scenes",
    "derived_from": "made from run",
    "num_frames": "frames",
    "num_views": "images",
    "num_images": "images",
    "num_recorded": "recorded images",
    "num_points": "LiDAR points",
    "num_sweeps": "LiDAR sweeps",
    "num_actors": "actors",
    "num_actor": "actors",
    "num_moving_actors": "moving actors",
    "num_street": "blocks of street",
    "num_assets": "assets",
    "num_pictures": "pictures",
    "num_moments": "moments",
    "num_gaussians": "Gaussians",
    "num_sightings": "times seen",
    "num_bytes": "size",
    "bytes": "size",
    "peak_memory_bytes": "peak memory",
    "seconds": "wall time, s",
    "cpu_seconds": "CPU time, s",
    "duration_s": "duration, s",
    "time_s": "time since the first image, s",
    "started_at": "started, UTC",
    "finished_at": "finished, UTC",
    "created_at": "made, UTC",
    "artefact_id": "artefact",
    "painter_id": "painter",
    "asset_id": "asset",
    "actor_id": "actor",
    "is_moving": "moves",
    "length_m": "length, m",
    "width_m": "width, m",
    "height_m": "height, m",
    "distance_m": "distance at first, m",
    "median_m": "median distance, m",
    "sides": "sides seen",
    "coverage": "directions seen, share",
    "seen_share": "surface seen, share",
    "score": "score 0 to 1, higher is better",
    "fit_seed": "seed of the fit",
    "cause": "ended as",
    "fps": "images a second",
    "frame": "axes",
    "psnr": PSNR,
    "psnr_db": PSNR,
    "ssim": SSIM,
    "lpips": LPIPS,
    "worst_psnr": "PSNR of the worst view, dB",
    "actors_psnr": "PSNR inside actor boxes, dB, higher is better",
    "feature_distance": "feature distance, lower is better",
    "depth_within_5_percent": "LiDAR met within 5 %, share, higher is better",
    "flicker": "flicker, lower is better",
    "moving_flicker": "flicker of movers, lower is better",
    "valid_share": "pixels compared, share",
    "num_pairs": "pairs of images",
    "edge_f1": "edges kept, F1, higher is better",
    "edge_precision": "new edges that are true, share, higher is better",
    "edge_recall": "true edges that stay, share, higher is better",
    "edge_judged_share": "pixels whose edges are compared, share",
    "recorded_psnr": "PSNR of held-out views, dB, higher is better",
    "recorded_ssim": "SSIM of held-out views, higher is better",
    "recorded_lpips": "LPIPS of held-out views, lower is better",
    "aside_psnr": "PSNR 2 and 3 m aside, dB, higher is better",
    "aside_depth": "LiDAR met within 5 % aside, share, higher is better",
}
"""What people read in place of the name of a field, whatever table it stands in."""


def heading_of(name: str) -> str:
    """A field in words; what is no known field is words already, or has its strokes taken out."""
    return HEADINGS.get(name, name if " " in name else name.replace("_", " "))


def table_lines(
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[str]],
    sides: Sequence[Side],
    *,
    width: int,
) -> Iterator[str]:
    """The lines of a table of at most so many columns; row by row where it has no room."""
    yield title
    columns = [[heading, *(row[i] for row in rows)] for i, heading in enumerate(headings)]
    widths = _fitting(columns, width)
    if widths is None:
        for row in rows:
            yield ""
            shown = {name: cell for name, cell in zip(headings, row, strict=True) if cell != ABSENT}
            yield from pair_lines(shown, width=width)
        return
    yield from _row_lines(headings, widths, sides)
    yield GAP.join("-" * one for one in widths)
    for row in rows:
        yield from _row_lines(row, widths, sides)


def pair_lines(pairs: Mapping[str, str], *, width: int) -> Iterator[str]:
    """Names and values beside each other; a value that is one long word is never broken."""
    names = max(map(len, pairs), default=0)
    names = min(names, width // 2)
    for name, value in pairs.items():
        left = _wrapped(name, names)
        right = [line for part in value.splitlines() for line in _wrapped(part, width - names - 4)]
        for number in range(max(len(left), len(right))):
            first = left[number] if number < len(left) else ""
            second = right[number] if number < len(right) else ""
            yield f"  {first:<{names}}{GAP}{second}".rstrip()


def _fitting(columns: Sequence[Sequence[str]], width: int) -> list[int] | None:
    """How wide each column is so that all fit, the widest ones wrapped; None if they cannot."""
    least = [
        max(len(word) for cell in column for word in ["", *cell.split()]) for column in columns
    ]
    widths = [max(len(cell) for cell in column) for column in columns]
    excess = sum(widths) + len(GAP) * (len(columns) - 1) - width
    floors = [max(low, min(LEAST_TEXT, one)) for one, low in zip(widths, least, strict=True)]
    while excess > 0:
        if all(one <= floor for one, floor in zip(widths, floors, strict=True)):
            if floors == least:
                return None
            floors = least
            continue
        wide = [i for i, floor in enumerate(floors) if widths[i] > floor]
        widths[max(wide, key=widths.__getitem__)] -= 1
        excess -= 1
    return widths


def _row_lines(cells: Sequence[str], widths: Sequence[int], sides: Sequence[Side]) -> Iterator[str]:
    """A row of cells, on as many lines as its longest cell takes."""
    parts = [_wrapped(cell, width) for cell, width in zip(cells, widths, strict=True)]
    for number in range(max(map(len, parts), default=0)):
        line = [part[number] if number < len(part) else "" for part in parts]
        placed = [
            one.rjust(width) if side == "right" else one.ljust(width)
            for one, width, side in zip(line, widths, sides, strict=True)
        ]
        yield GAP.join(placed).rstrip()


def _wrapped(text: str, width: int) -> list[str]:
    """A text in lines that break between words alone."""
    plain = textwrap.wrap(text, max(width, 1), break_long_words=False, break_on_hyphens=False)
    return plain or [""]
