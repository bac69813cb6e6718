"""Fuse the sightings of one vehicle into one that is better than each, and enter it.

The light of two runs is compared by all vehicles that both show: what a road is taken for errs for
all of a run alike, and one vehicle alone may show both ways of seeing it no common place. Artefacts
are keyed on those of the sightings, so the same ones again cost nothing, and one that is published
anew makes the fused one anew.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch

from catalog.artefacts import ArtefactRef, Workplace
from catalog.assets import FUSED_KIND, enter_fused, to_fuse
from catalog.store import Store
from catalog.tables import Row
from lidarpainter_models.assets.asset_files import ABOUT_FILE, read_asset
from lidarpainter_models.assets.fusion import compared, fused_vehicle
from lidarpainter_models.assets.sighted_vehicles import SIGHTED_FILE, read_sighted
from lidarpainter_models.assets.written_actors import write_actor
from tasks.json_files import read_json
from tasks.progress import Progress
from tasks.stages import StageResult, run_stage

FOLDER = "actor"
LEAST_PLACES = 40
"""Of fewer places that two runs show of the same vehicles their light cannot be compared."""
MOST_PLACES = 300
"""One vehicle counts for no more: its paint may shine."""

Gain = tuple[float, float, float]
Light = Mapping[tuple[str, str], Gain]
"""Logarithm of how much brighter the sightings of one artefact are than those of another."""


def fuse_sightings(store: Store, asset_ids: Iterable[str]) -> list[str]:
    """Fuse what was seen of assets more than once; returns those of which a fused one stands.

    Only vehicles that were made whole are fused, and only what was published with what that needs.

    Raises:
        DataError: a file of a sighting is damaged.
        CatalogError: the files of a sighting are gone, or the store cannot be written.
    """
    groups = to_fuse(store, asset_ids)
    if not groups:
        return []
    members = {
        name: [row for row in rows if _is_kept(store, row) and _heads_alike(rows[0], row)]
        for name, rows in groups.items()
    }
    light = _light(store, [rows for rows in members.values() if len(rows) > 1])
    made = {name: (rows, _fused(store, members[name], light)) for name, rows in groups.items()}
    return enter_fused(store, made)


def _light(store: Store, groups: Iterable[Sequence[Row]]) -> Light:
    """How the light of artefacts differs, by all vehicles that two of them show."""
    told: dict[tuple[str, str], list[tuple[Gain, int]]] = defaultdict(list)
    for rows in groups:
        compare = partial(_compare, store=store, rows=rows)
        found = _run(store, "compare-sightings", rows, None, compare).summary["comparisons"]
        for row, one in zip(rows[1:], found[1:], strict=True):
            ratio, count = one["log_ratio"], min(MOST_PLACES, one["num_places"])
            pair = (rows[0]["artefact_id"], row["artefact_id"])
            told[pair].append((ratio, count))
            told[pair[::-1]].append(((-ratio[0], -ratio[1], -ratio[2]), count))
    middles = {pair: _middle(some) for pair, some in told.items()}
    return {pair: middle for pair, middle in middles.items() if middle is not None}


def _middle(told: Iterable[tuple[Gain, int]]) -> Gain | None:
    """The median by places, channel by channel, to a hundredth; None of too few places.

    By places: each comparison counts as often as it has some.
    """
    ratios = [ratio for ratio, count in told for _ in range(count)]
    if len(ratios) < LEAST_PLACES:
        return None
    red, green, blue = (round(median(channel), 2) for channel in zip(*ratios, strict=True))
    return red, green, blue


def _gains(rows: Sequence[Row], light: Light) -> dict[int, Gain]:
    """Gains of those sightings whose light is known, by place; their geometric mean is 1."""
    first = rows[0]["artefact_id"]
    logs = {0: (0.0, 0.0, 0.0)}
    for place, row in enumerate(rows[1:], start=1):
        if row["artefact_id"] == first:
            logs[place] = logs[0]
        elif (first, row["artefact_id"]) in light:
            logs[place] = light[first, row["artefact_id"]]
    mean = [sum(some) / len(logs) for some in zip(*logs.values(), strict=True)]
    found = {}
    for place, log in logs.items():
        red, green, blue = (math.exp(one - other) for one, other in zip(log, mean, strict=True))
        found[place] = (red, green, blue)
    return found


def _fused(store: Store, rows: Sequence[Row], light: Light) -> Row | None:
    """The row of what some sightings of one thing yield; None where they yield nothing."""
    gains = _gains(rows, light) if rows else {}
    if len(gains) < 2:
        return None
    members = [rows[place] for place in gains]
    given = list(gains.values())
    fuse = partial(_fuse, store=store, rows=members, gains=given)
    made = _run(store, "fuse-sightings", members, given, fuse)
    record = made.summary["record"]
    if record is None:
        return None
    manifest = store.artefacts.manifest(made.ref)
    taken = [members[number] for number in made.summary["taken"]]
    return {
        **members[0],
        **record,
        "fused_from": [row["sighting_id"] for row in taken],
        "licence": "; ".join(sorted({row["licence"] for row in taken})),
        "artefact_id": made.ref.artefact_id,
        "created_at": datetime.fromisoformat(manifest.created_at),
        "software_version": manifest.software_version,
    }


def _run(
    store: Store,
    stage: str,
    rows: Sequence[Row],
    gains: Sequence[Gain] | None,
    build: Callable[[Workplace, Progress], Mapping[str, Any]],
) -> StageResult:
    """A stage that is made of sightings and what brings them into one light."""
    refs = [ArtefactRef.of_id(row["artefact_id"]) for row in rows]
    part = "compared" if gains is None else "sighting"
    return run_stage(
        store,
        stage=stage,
        kind=FUSED_KIND,
        inputs={
            # other vehicles of the same runs are made from other parts
            f"{part} {number} in {row['folder']}": ref.digest
            for number, (row, ref) in enumerate(zip(rows, refs, strict=True))
        },
        config={"gains": gains},
        build=build,
    )


def _is_kept(store: Store, row: Row) -> bool:
    """Whether a sighting was published with what fusing needs of it."""
    manifest = store.artefacts.manifest(ArtefactRef.of_id(row["artefact_id"]))
    return f"{row['folder']}/{SIGHTED_FILE}" in manifest.files


def _heads_alike(one: Row, other: Row) -> bool:
    """Whether the boxes of what stands in one frame do not head opposite ways."""
    if one["is_moving"] or other["is_moving"] or one["frame"] != other["frame"]:
        return True
    return math.cos(one["heading_rad"] - other["heading_rad"]) > 0


def _folder(store: Store, row: Row) -> Path:
    """The files of a sighting, at hand."""
    ref = ArtefactRef.of_id(row["artefact_id"])
    named = [
        one for one in store.artefacts.manifest(ref).files if one.startswith(row["folder"] + "/")
    ]
    return store.artefacts.files(ref, named) / row["folder"]


def _compare(
    _place: Workplace, _progress: Progress, *, store: Store, rows: Sequence[Row]
) -> Mapping[str, Any]:
    folders = [_folder(store, row) for row in rows]
    seen = [read_sighted(folder / SIGHTED_FILE) for folder in folders]
    return {"comparisons": [asdict(one) for one in compared(seen, read_asset(folders[0]))]}


def _fuse(
    place: Workplace,
    _progress: Progress,
    *,
    store: Store,
    rows: Sequence[Row],
    gains: Sequence[Gain],
) -> Mapping[str, Any]:
    folders = [_folder(store, row) for row in rows]
    fused = fused_vehicle(
        [read_sighted(folder / SIGHTED_FILE) for folder in folders],
        [read_asset(folder) for folder in folders],
        torch.tensor(gains),
    )
    if fused is None:
        return {"record": None}
    judged_on = rows[0]["judged_on"] or "training"
    record = write_actor(
        fused.whole,
        fused.sighting,
        place.output,
        FOLDER,
        judged_on=judged_on,
        like=torch.tensor(read_json(folders[0] / ABOUT_FILE)["evidence"]),
    )
    files = (place.output / FOLDER).iterdir()
    return {
        "record": record | {"num_bytes": sum(path.stat().st_size for path in files)},
        "taken": list(fused.taken),
    }
