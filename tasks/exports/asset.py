"""Take assets out of the store: one as a file of other programs, many as a page to leaf through."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch

from catalog.artefacts import ArtefactRef
from catalog.errors import CatalogError, UnknownRecordError
from catalog.store import Store
from catalog.tables import Row
from lidarpainter_models.assets.asset_files import (
    FRAME,
    GAUSSIANS_FILE,
    SIZE_COMMENT,
    read_asset,
)
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.contents import SceneContents
from lidarpainter_models.export.formats import FORMATS, ExportFormat, export_format
from lidarpainter_models.export.gallery import DATA, PAGE, write_gallery
from lidarpainter_models.gaussians.model.ply_files import write_ply
from tasks.exports.places import new_folder


def export_asset(store: Store, asset: Row, wanted: str, out: Path) -> dict[str, Any]:
    """Write an actor or a block of street in its own frame.

    Raises:
        ConfigError: no such format, the name ends otherwise, or the asset is no Gaussians.
        CatalogError: its files are gone.
        WriteError: the disk refuses; nothing is left half-written.
    """
    row = export_format(wanted)
    if not row.takes_assets:
        known = ", ".join(one.name for one in FORMATS if one.takes_assets)
        raise ConfigError(f"--format {wanted!r}: expected one of {known}")
    if out.suffix.lower() not in row.endings:
        raise ConfigError(f"{out.name}: expected a name in {', '.join(row.endings)}")
    folder = asset_path(store, asset, "folder")
    if folder is not None:
        store.artefacts.files(ArtefactRef.of_id(asset["artefact_id"]))
    if folder is None or not folder.is_dir():
        raise CatalogError(f"the files of asset {asset['asset_id']} are gone, expected {folder}")
    if not (folder / GAUSSIANS_FILE).is_file():
        raise ConfigError(
            f"a {asset['kind']} has no Gaussians to export; its files are in {folder}"
        )
    model = read_asset(folder)
    _write(model, asset, row, out)
    return {
        "asset_id": asset["asset_id"],
        "path": str(out),
        "num_bytes": out.stat().st_size,
        "num_gaussians": len(model.gaussians),
        "frame": FRAME,
        "licence": asset["licence"],
    }


def _write(model: ActorModel, asset: Row, row: ExportFormat, out: Path) -> None:
    """Write an asset alone, with its box; a PLY file says in comments whose it is."""
    if row.name == "ply":
        size = " ".join(f"{side:.4f}" for side in model.size_m.tolist())
        named = f"asset {asset['asset_id']}, {asset['category']}"
        said = (named, f"{SIZE_COMMENT} {size}", FRAME, asset["licence"])
        write_ply(out, model.gaussians, [" ".join(str(one).split()) for one in said])
        return
    alone = SceneContents(
        name=asset["name"],
        street=model.gaussians,
        actors=(),
        timestamps_ns=torch.zeros(1, dtype=torch.int64),
        world_from_actor=torch.zeros(1, 0, 4, 4, dtype=torch.float64),
        is_present=torch.zeros(1, 0, dtype=torch.bool),
    )
    row.load_writer()(out, alone)


def export_gallery(store: Store, assets: Sequence[Row], out: Path) -> dict[str, Any]:
    """Write a page of assets to a new folder, or in place of an older gallery.

    Raises:
        ConfigError: the folder holds something else.
        WriteError: the disk refuses; an older gallery stays.
    """
    with new_folder(out, replaces=(DATA, PAGE)) as folder:
        _fetch_pictures(store, assets)
        picture_of = partial(asset_path, store, column="thumbnail")
        num_pictures = write_gallery(folder, assets, picture_of)
    return {"path": str(out / PAGE), "num_assets": len(assets), "num_pictures": num_pictures}


def _fetch_pictures(store: Store, assets: Sequence[Row]) -> None:
    """See that the pictures lie here, asking a bucket once for each artefact."""
    wanted: dict[str, list[str]] = {}
    for asset in assets:
        if asset_path(store, asset, "thumbnail") is not None:
            wanted.setdefault(asset["artefact_id"], []).append(asset["thumbnail"])
    for name, pictures in wanted.items():
        with suppress(UnknownRecordError):  # its files are gone
            store.artefacts.files(ArtefactRef.of_id(name), pictures)


def asset_path(store: Store, asset: Mapping[str, Any], column: str) -> Path | None:
    """Where a file or folder of an asset lies; None where it has none.

    Raises:
        CatalogError: the row leads out of its artefact.
    """
    if asset[column] is None:
        return None
    artefact = store.artefacts.folder(ArtefactRef.of_id(asset["artefact_id"]))
    path = artefact / asset[column]
    if ".." in path.parts or not path.is_relative_to(store.root / "artefacts"):
        raise CatalogError(f"{column} of asset {asset['asset_id']} leads out of the store: {path}")
    return path
