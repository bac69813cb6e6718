"""A page to leaf through thousands of assets, each turning on its table; opens from the disk.

The page loads what lies beside it, and its policy lets it load nothing else: its script,
`assets.js` (a browser reads no JSON from a disk) and the pictures in `thumbnails/`. Only what is in
view is in the page. Page and script are the same for every library.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from lidarpainter_models.storage.whole_files import storage_errors

FIELDS = (
    *("asset_id", "kind", "category", "name", "dataset", "licence", "style", "actor_id", "run_id"),
    *("scene_ids", "length_m", "width_m", "height_m", "sides", "coverage", "score"),
    *("seen_share", "mirrored_share", "guessed_share"),
    *("psnr_db", "lpips", "num_views", "num_points", "num_gaussians", "num_sightings"),
    "fused_from",
)
"""What the page knows of an asset; it may lack any but `asset_id` and `kind`."""
PAGE, SCRIPT, DATA, PICTURES = "index.html", "gallery.js", "assets.js", "thumbnails"


def write_gallery(
    folder: Path,
    assets: Iterable[Mapping[str, Any]],
    picture_of: Callable[[Mapping[str, Any]], Path | None],
) -> int:
    """Write the page and what it shows to a folder; returns how many assets have a picture.

    Assets are values by `FIELDS`; `picture_of` gives the strip of pictures of one, azimuths side by
    side, each of 4 by 3.

    Raises:
        WriteError: the disk refuses.
    """
    rows, num_pictures = [], 0
    with storage_errors(folder):
        (folder / PICTURES).mkdir(parents=True)
        for number, asset in enumerate(assets):
            picture, name = picture_of(asset), None
            if picture is not None and picture.is_file():
                name = f"{PICTURES}/{number:06d}{picture.suffix}"
                shutil.copyfile(picture, folder / name)
                num_pictures += 1
            rows.append([*(_plain(asset.get(field)) for field in FIELDS), name])
        library = json.dumps({"fields": [*FIELDS, "picture"], "rows": rows}, allow_nan=False)
        (folder / DATA).write_text(f"const LIBRARY = {library};\n", "utf-8")
        here = files("lidarpainter_models.export")
        for name, source in ((PAGE, "gallery.html"), (SCRIPT, SCRIPT)):
            (folder / name).write_bytes(here.joinpath(source).read_bytes())
    return num_pictures


def _plain(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Numbers that JSON lacks become null, and others as short as anyone reads them."""
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    return value
