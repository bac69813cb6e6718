"""Enter somebody else's file as an actor of the library; `imported` is its data set and origin."""

from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from catalog.artefacts import Workplace
from catalog.assets import enter_sightings
from catalog.digests import canonical_json, digest_text
from catalog.schemas import SIGHTINGS
from catalog.store import Store
from lidarpainter_models.assets.asset_files import write_asset
from lidarpainter_models.assets.foreign_files import ForeignFolder, ForeignShape
from lidarpainter_models.assets.import_formats import import_format
from lidarpainter_models.assets.placing import Placement, placed_actor
from lidarpainter_models.assets.turntables import THUMBNAIL_FILE, turntable
from lidarpainter_models.errors import DataError
from lidarpainter_models.export.images import write_webp
from tasks.assets.enter import is_same, sighting
from tasks.assets.publish import KIND
from tasks.progress import Progress
from tasks.stages import run_stage

ORIGIN, FOLDER = "imported", "actor"
NO_LICENCE = "not said"
NAME_LENGTH = 40


def import_file(
    store: Store, path: Path, placement: Placement, licence: str | None
) -> dict[str, Any]:
    """Write a file as an artefact and enter it; the same file again replaces its own row.

    Without a licence the one that is known of the file stays.

    Returns:
        What `--json` prints.

    Raises:
        ConfigError: the format is not known.
        DataError: the file cannot be used.
    """
    row, folder = import_format(path), ForeignFolder(path)
    shape = row.read(folder)
    digest = digest_text(canonical_json(folder.contents))
    made = run_stage(
        store,
        stage="import-asset",
        kind=KIND,
        inputs={"file": digest},
        config=placement,
        build=partial(_build, path=path, shape=shape, placement=placement),
    )
    manifest, place = store.artefacts.manifest(made.ref), f"{ORIGIN}/{digest[:16]}"
    same = {
        "dataset": ORIGIN,
        "scene_id": place,
        "frame": place,
        "licence": licence or _known_licence(store, digest),
        "run_id": None,
        "style": None,
        "artefact_id": made.ref.artefact_id,
        "created_at": datetime.fromisoformat(manifest.created_at),
        "software_version": manifest.software_version,
    }
    record = {"kind": "actor", "actor_id": digest, "folder": FOLDER, **made.summary["record"]}
    (asset_id,) = enter_sightings(store, [sighting(same, record)], is_same)
    return {
        "asset_id": asset_id,
        **made.summary["record"],
        **made.summary["told"],
        "artefact": str(store.artefacts.folder(made.ref)),
        "is_new": made.is_new,
    }


def _known_licence(store: Store, digest: str) -> str:
    """What an earlier import of the same file said."""
    rows = store.tables.rows(SIGHTINGS.name, where={"actor_id": {digest}})
    return next((row["licence"] for row in rows if row["dataset"] == ORIGIN), NO_LICENCE)


def _build(
    place: Workplace, _progress: Progress, *, path: Path, shape: ForeignShape, placement: Placement
) -> Mapping[str, Any]:
    try:
        model, up, forward = placed_actor(shape, import_format(path), placement)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    folder, told = place.output / FOLDER, {"file": path.name, "up": up, "forward": forward}
    write_asset(folder, model, {"origin": ORIGIN, **told})
    write_webp(turntable(model.gaussians, model.size_m), folder / THUMBNAIL_FILE)
    stem = "".join(one for one in path.stem if one.isprintable())[:NAME_LENGTH]
    sides = ("length_m", "width_m", "height_m")
    record = {
        "category": placement.category,
        "name": f"{placement.category} {stem}",
        **dict(zip(sides, model.size_m.tolist(), strict=True)),
        "num_gaussians": len(model.gaussians),
        "thumbnail": f"{FOLDER}/{THUMBNAIL_FILE}",
        "num_bytes": sum(one.stat().st_size for one in folder.iterdir()),
    }
    return {"record": record, "told": told}
