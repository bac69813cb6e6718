"""The actors of the library of assets, for scenes that are served."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from catalog.errors import CatalogError
from catalog.store import Store
from catalog.tables import Row
from lidarpainter_models.assets.asset_files import read_asset
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.errors import DataError
from lidarpainter_models.serving.refusals import invalid
from tasks.editing.donors import LibraryActor

SIDES = ("length_m", "width_m", "height_m")


@dataclass(frozen=True, eq=False)
class StoredActors:
    """What `assets publish` entered, as it was when somebody first asked."""

    store: Store

    @cached_property
    def _rows(self) -> list[Row]:
        """Actors as they were recorded, those seen best first."""
        columns = ["asset_id", "kind", "category", "style", "score", *SIDES]
        rows = self.store.tables.arrow("assets", columns=columns).to_pylist()
        found = [row for row in rows if row["kind"] == "actor" and row["style"] is None]
        return sorted(found, key=lambda row: (-(row["score"] or 0.0), row["asset_id"]))

    @property
    def names(self) -> Sequence[str]:
        """Ids of the assets."""
        return [row["asset_id"] for row in self._rows]

    @cached_property
    def categories(self) -> Sequence[str]:
        """Their classes, longest first: `pickup truck` before `truck`."""
        return sorted({row["category"] for row in self._rows}, key=lambda one: (-len(one), one))

    def model(self, name: str) -> ActorModel:
        """What an asset looks like.

        Raises:
            RequestError: INVALID_ARGUMENT: it is not there, no actor, or its files are damaged.
        """
        try:
            return _read(self.store, name)
        except (CatalogError, DataError, ValueError) as error:
            raise invalid(f"asset {name[:80]!r}: {error}") from None

    def nearest(self, category: str, size_m: Float[Tensor, "3"] | None) -> str:
        """The asset whose box is nearest to a size, of the same class if there is one.

        Where no size is told it is the usual one of the class. Of equal ones the best is taken.

        Raises:
            RequestError: INVALID_ARGUMENT: the library has no actors.
        """
        if not self._rows:
            raise invalid("the library has no actors: `assets publish` enters those of a run")
        word = category.lower()
        same = [row for row in self._rows if word and _is_of(row, word)] or self._rows
        usual = torch.tensor([median(row[side] for row in same) for side in SIDES])
        wanted_m = usual if size_m is None else size_m
        away = [float((_size_m(row) - wanted_m).norm()) for row in same]
        return same[away.index(min(away))]["asset_id"]


def _is_of(row: Row, word: str) -> bool:
    own = row["category"].lower()
    return word in (own, own.rpartition(".")[2]) or own in word


def _size_m(row: Row) -> Float[Tensor, "3"]:
    return torch.tensor([row[side] for side in SIDES])


@lru_cache(maxsize=32)
def _read(store: Store, name: str) -> ActorModel:
    return read_asset(LibraryActor.named(store, name).path).with_points_all_round()
