"""Rows of the asset library by the thousand, drawn from a seed: what logs of many scenes yield."""

import hashlib

import numpy as np
import pyarrow as pa

from catalog.schemas import TABLES

ACTORS_A_SCENE = 50
SIDES = ("front", "rear", "left", "right", "top")
CARS = {"pandaset": "Car", "nuscenes": "vehicle.car", "synthetic": "car"}
LICENCES = {"pandaset": "CC BY 4.0", "nuscenes": "CC BY-NC-SA 4.0", "synthetic": "CC0"}
OTHERS = ("Pedestrian", "Bus", "Medium-sized Truck", "Bicycle", "Pickup Truck")
STYLES = (None, "night", "foggy", "rain")


def asset_rows(count, *, first=0):
    """Assets `first` to `first + count` of an endless library, as Arrow."""
    numbers = np.arange(first, first + count)
    rng = np.random.default_rng(first)
    scenes = numbers // ACTORS_A_SCENE
    datasets = [list(CARS)[scene % len(CARS)] for scene in scenes]
    others = rng.integers(0, len(OTHERS), count)
    categories = [
        CARS[dataset] if is_car else OTHERS[other]
        for dataset, is_car, other in zip(datasets, rng.random(count) < 0.6, others, strict=True)
    ]
    scene_ids = [f"{one}/{scene:05d}" for one, scene in zip(datasets, scenes, strict=True)]
    seen = rng.random((count, len(SIDES))) < 0.55
    offsets = np.concatenate([[0], seen.sum(1).cumsum()]).astype(np.int32)
    artefacts = [f"assets/{scene:064x}" for scene in scenes]
    created_at = pa.array(numbers * 1_000_000).cast(pa.timestamp("us", tz="UTC"))
    columns = {
        "asset_id": [asset_id(number) for number in numbers],
        "kind": ["actor"] * count,
        "category": categories,
        "name": [f"{one} {number}" for one, number in zip(categories, numbers, strict=True)],
        "dataset": datasets,
        "licence": [LICENCES[one] for one in datasets],
        "scene_ids": [[one] for one in scene_ids],
        "run_id": [f"{scene:016x}" for scene in scenes],
        "actor_id": [f"track-{number % ACTORS_A_SCENE}" for number in numbers],
        "style": [STYLES[one] for one in rng.integers(0, len(STYLES), count)],
        "length_m": rng.uniform(0.5, 6.0, count),
        "width_m": rng.uniform(0.5, 2.5, count),
        "height_m": rng.uniform(1.3, 3.0, count),
        "num_gaussians": rng.integers(100, 20_000, count),
        "num_points": rng.integers(0, 50_000, count),
        "num_sightings": rng.integers(1, 4, count),
        "num_views": rng.integers(1, 200, count),
        "sides": pa.ListArray.from_arrays(offsets, pa.array(SIDES).take(np.nonzero(seen)[1])),
        "coverage": rng.random(count),
        "sharpness": rng.random(count),
        "psnr_db": rng.uniform(15, 35, count),
        "lpips": pa.array(rng.uniform(0, 0.4, count), mask=rng.random(count) < 0.2),
        "judged_on": ["held-out"] * count,
        "occlusion": rng.random(count),
        "score": rng.random(count),
        "artefact_id": artefacts,
        "folder": [f"actor-{number % ACTORS_A_SCENE:03d}" for number in numbers],
        "num_bytes": rng.integers(10_000, 10_000_000, count),
        "created_at": created_at,
        "software_version": ["0.2.0"] * count,
    }
    return _table("assets", columns, count)


def sighting_rows(count, *, first=0):
    """A sighting of each of these assets, standing far from all others of its scene, as Arrow."""
    assets = asset_rows(count, first=first)
    numbers = np.arange(first, first + count)
    scene_ids = [one for (one,) in assets["scene_ids"].to_pylist()]
    columns = {name: assets[name].combine_chunks() for name in assets.column_names}
    columns |= dict.fromkeys(("sighting_id", "occurrence_id"), columns["asset_id"])
    columns |= {"is_moving": [False] * count}
    columns |= {"scene_id": scene_ids, "frame": scene_ids}
    columns |= {"x_m": numbers % ACTORS_A_SCENE * 100.0, "y_m": np.zeros(count)}
    return _table("sightings", columns, count)


def _table(name, columns, count):
    """Rows of a table; what is not given is null."""
    schema = TABLES[name].arrow
    arrays = [
        pa.array(columns[field.name], field.type)
        if field.name in columns
        else pa.nulls(count, field.type)
        for field in schema
    ]
    return pa.table(arrays, schema=schema)


def asset_id(number):
    """As digests are: two that follow each other have nothing in common."""
    return hashlib.sha256(str(number).encode()).hexdigest()[:16]
