"""Actors as folders of files, with what the catalog knows of each."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.assets.asset_files import write_asset
from lidarpainter_models.assets.completion import WholeActor
from lidarpainter_models.assets.expected_quality import (
    directions,
    evidence_of,
    expected_psnr_db,
    score_of,
)
from lidarpainter_models.assets.sightings import Sighting
from lidarpainter_models.assets.turntables import write_turntable
from lidarpainter_models.editing.actor_models import ActorModel

Record = dict[str, Any]
"""What is known of one asset; its names are those of the catalog's table `sightings`."""


def write_actor(
    whole: WholeActor,
    seen: Sighting,
    output: Path,
    folder: str,
    *,
    judged_on: str,
    like: Float[Tensor, "directions evidence"] | None = None,
) -> Record:
    """Write an actor into a folder below `output`, and say what is known of it.

    Args:
        whole: the actor in neutral exposure.
        seen: what the images show of it.
        output: where the folder is made.
        folder: name of the folder.
        judged_on: which images its errors are of.
        like: evidence of the sighting that its score is held against, see `evidence_of`.

    Raises:
        WriteError: the disk refuses.
    """
    model = whole.model
    measured = _measured(seen, judged_on)
    measured |= {f"{name}_share": share for name, share in whole.shares.items()}
    expected = _expected(whole, seen, like)
    measured["score"] = expected.get("score", seen.score)
    looks = [[one.azimuth_deg, one.elevation_deg, one.distance_m] for one in seen.near_looks]
    write_asset(
        output / folder, model, {**expected, **measured, "looks": looks}, origin=whole.origin
    )
    return {
        "kind": "actor",
        **sized(model),
        **measured,
        "folder": folder,
        "thumbnail": write_turntable(output, folder, model, elevation_deg=15.0),
    }


def sized(model: ActorModel) -> Record:
    """Length, width and height of a model, and how many Gaussians and points it has."""
    length_m, width_m, height_m = model.size_m.tolist()
    return {
        "length_m": length_m,
        "width_m": width_m,
        "height_m": height_m,
        "num_gaussians": len(model.gaussians),
        "num_points": len(model.points),
    }


def _expected(
    whole: WholeActor, seen: Sighting, like: Float[Tensor, "directions evidence"] | None
) -> Record:
    """Of a vehicle that was made whole, how right it is expected to look; else nothing."""
    if whole.surface is None:
        return {}
    evidence = evidence_of(whole, seen, like)
    psnr_db = expected_psnr_db(evidence)
    return {
        "score": score_of(psnr_db),
        "directions_deg": torch.rad2deg(directions()).tolist(),
        "expected_psnr_db": psnr_db.tolist(),
        "evidence": evidence.tolist(),
    }


def _measured(seen: Sighting, judged_on: str) -> Record:
    """The numbers of a sighting, as the catalog calls them."""
    distances_m = torch.tensor([look.distance_m for look in seen.near_looks])
    return {
        "num_views": len(seen.near_looks),
        "nearest_m": float(distances_m.min()),
        "median_m": float(distances_m.median()),
        "pixels_per_m": seen.pixels_per_m,
        "sides": seen.sides,
        "coverage": seen.coverage,
        "sharpness": seen.sharpness,
        "psnr_db": seen.psnr_db,
        "judged_on": None if seen.psnr_db is None else judged_on,
        "occlusion": seen.occlusion,
        "score": seen.score,
    }
