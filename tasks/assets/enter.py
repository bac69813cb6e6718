"""Enter what a run yielded into the catalog, and tell what was seen before.

Two sightings are of one thing if scene and name are the same; if a data set gave both tracks one
id that it gives but once; or if both stand and their boxes overlap in one global frame.
"""

import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import cv2

from catalog.assets import LEAST_ID_LENGTH, digest_of, enter_sightings
from catalog.store import Store
from catalog.tables import Row
from lidarpainter_models.scenes.categories import category_of
from tasks.assets.publish import SIGHTINGS_FILE
from tasks.json_files import read_json
from tasks.opened import global_frame_of, open_scene
from tasks.runs import FinishedRun
from tasks.stages import StageResult

LEAST_OVERLAP = 0.25
"""Intersection over union from above: boxes of one car drawn twice share more, cars that park side
by side touch none of it."""


def enter_published(
    store: Store, run: FinishedRun, published: StageResult, style: str | None
) -> list[str]:
    """Enter the sightings of a published run; returns the ids of their assets."""
    scene = open_scene(store, run.scene_id)
    manifest = store.artefacts.manifest(published.ref)
    same = {
        "dataset": run.scene_id.partition("/")[0],
        "licence": scene.manifest["licence"],
        "scene_id": run.scene_id,
        "frame": global_frame_of(scene),
        "run_id": run.run_id,
        "style": style,
        "artefact_id": published.ref.artefact_id,
        "created_at": datetime.fromisoformat(manifest.created_at),
        "software_version": manifest.software_version,
    }
    records = read_json(store.artefacts.files(published.ref, [SIGHTINGS_FILE]) / SIGHTINGS_FILE)
    rows = [sighting(same, record) for record in records]
    return enter_sightings(store, rows, is_same)


def sighting(same: Mapping[str, Any], record: Mapping[str, Any]) -> Row:
    """The row of a record, with what it has in common with all of its run."""
    category = category_of(record["category"])
    return {**same, **record, "category": category, **ids_of(same, record)}


def is_same(one: Row, other: Row) -> bool:
    """Whether two sightings are of one thing."""
    if one["occurrence_id"] == other["occurrence_id"]:
        return True
    if one["kind"] != "actor" or any(
        one[name] != other[name] for name in ("kind", "dataset", "style", "category")
    ):
        return False
    if one["actor_id"] == other["actor_id"] and len(one["actor_id"]) >= LEAST_ID_LENGTH:
        return True
    if one["is_moving"] or other["is_moving"] or one["frame"] != other["frame"]:
        return False
    return _overlap(one, other) >= LEAST_OVERLAP


def _overlap(one: Row, other: Row) -> float:
    """Intersection over union of two boxes from above; 0 where one is over the other."""
    if abs(one["z_m"] - other["z_m"]) > (one["height_m"] + other["height_m"]) / 2:
        return 0.0
    # from the first box on: a global frame has more digits than OpenCV's floats
    first, second = (
        (
            (row["x_m"] - one["x_m"], row["y_m"] - one["y_m"]),
            (row["length_m"], row["width_m"]),
            math.degrees(row["heading_rad"]),
        )
        for row in (one, other)
    )
    kind, corners = cv2.rotatedRectangleIntersection(first, second)
    if kind == cv2.INTERSECT_NONE or corners is None:
        return 0.0
    common = cv2.contourArea(cv2.convexHull(corners))
    areas = sum(row["length_m"] * row["width_m"] for row in (one, other))
    return common / (areas - common)


def ids_of(same: Mapping[str, Any], record: Mapping[str, Any]) -> Row:
    """The ids of a sighting, whose names in a run and in a scene follow from it."""
    named = (record["kind"], record.get("actor_id") or record["name"])
    base = digest_of(same["scene_id"], *named, None)
    return {
        "sighting_id": digest_of(same["run_id"], *named),
        "occurrence_id": digest_of(same["scene_id"], *named, same["style"]),
        "base_id": None if same["style"] is None else base,
    }
