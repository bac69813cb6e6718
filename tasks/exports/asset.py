"""Take assets out of the store: one as a file of other programs, many as a page to leaf through."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from catalog.artefacts import ArtefactRef
from catalog.errors import CatalogError, UnknownRecordError
from catalog.store import Store
from catalog.tables import Row
from lidarpainter_models.assets.asset_files import FRAME, GAUSSIANS_FILE
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.contents import SceneContents
from lidarpainter_models.export.gallery import DATA, PAGE, write_gallery
from lidarpainter_models.export.gltf_files import write_gltf
from lidarpainter_models.export.spz_files import write_spz
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.ply_files import read_ply, write_ply
from lidarpainter_models.storage.whole_files import storage_errors
from lidarpainter_models.storage.whole_folders import AsideFolder
from tasks.exports.scene import ENDINGS

AssetFormat = Literal["ply", "spz", "gltf"]


def export_asset(store: Store, asset: Row, format_: AssetFormat, out: Path) -> dict[str, Any]:
    """Write an actor or a block of street in its own frame.

    Raises:
        ConfigError: the name ends otherwise, or the asset is a sky or a trajectory.
        CatalogError: its files are gone.
        WriteError: the disk refuses; nothing is left half-written.
    """
    if out.suffix.lower() not in ENDINGS[format_]:
        raise ConfigError(f"{out.name}: expected a name in {', '.join(ENDINGS[format_])}")
    folder = asset_path(store, asset, "folder")
    if folder is not None:
        store.artefacts.files(ArtefactRef.of_id(asset["artefact_id"]))
    if folder is None or not folder.is_dir():
        raise CatalogError(f"the files of asset {asset['asset_id']} are gone, expected {folder}")
    if not (folder / GAUSSIANS_FILE).is_file():
        raise ConfigError(
            f"a {asset['kind']} has no Gaussians to export; its files are in {folder}"
        )
    gaussians = read_ply(folder / GAUSSIANS_FILE)
    _write(gaussians, asset, format_, out)
    return {
        "asset_id": asset["asset_id"],
        "path": str(out),
        "num_bytes": out.stat().st_size,
        "num_gaussians": len(gaussians),
        "frame": FRAME,
        "licence": asset["licence"],
    }


def _write(gaussians: GaussianSet, asset: Row, format_: AssetFormat, out: Path) -> None:
    match format_:
        case "ply":
            said = (f"asset {asset['asset_id']}, {asset['category']}", FRAME, asset["licence"])
            write_ply(out, gaussians, [" ".join(str(one).split()) for one in said])
        case "spz":
            write_spz(out, gaussians)
        case "gltf":
            alone = SceneContents(
                name=asset["name"],
                street=gaussians,
                actors=(),
                timestamps_ns=torch.zeros(1, dtype=torch.int64),
                world_from_actor=torch.zeros(1, 0, 4, 4, dtype=torch.float64),
                is_present=torch.zeros(1, 0, dtype=torch.bool),
            )
            write_gltf(out, alone)


def export_gallery(store: Store, assets: Sequence[Row], out: Path) -> dict[str, Any]:
    """Write a page of assets to a new folder, or in place of an older gallery.

    Raises:
        ConfigError: the folder holds something else.
        WriteError: the disk refuses; an older gallery stays.
    """
    names = {path.name for path in out.iterdir()} if out.is_dir() else set()
    is_free = out.is_dir() or not (out.exists() or out.is_symlink())
    if not is_free or (names and not names >= {DATA, PAGE}):
        raise ConfigError(f"{out} is no gallery: expected a new folder, or an older gallery")
    folder = AsideFolder(out)
    try:
        with storage_errors(out):
            _fetch_pictures(store, assets)
            picture_of = partial(asset_path, store, column="thumbnail")
            num_pictures = write_gallery(folder.path, assets, picture_of)
            folder.publish()
    except BaseException:
        folder.discard()
        raise
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
