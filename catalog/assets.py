"""Assets out of sightings: which are of one thing, and which of them serves.

An asset is all sightings of one thing. Its id is the least `occurrence_id` among them, so it
follows from what was seen and not from who came first, and stays where a run is made anew. Its row
takes the columns of the sighting with the best score. Both tables are written under one lock.

What was fused from several sightings of an asset is a sighting of its own, whose `fused_from` names
them. It serves if its score is the best, and goes when one of them goes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from catalog.digests import canonical_json, digest_text
from catalog.errors import UnknownRecordError
from catalog.schemas import ASSETS, SIGHTINGS
from catalog.store import Store
from catalog.tables import Row

ID_LENGTH = 16
LOCK = "assets"
"""Held by whoever writes: what is one asset is decided from all that is there."""
LEAST_ID_LENGTH = 16
"""A track id of so many characters is given once, not counted anew in every sequence."""
FUSED_KIND = "fused"
"""Kind of the artefacts of what was fused."""
MOST_FUSED = 8
"""The best of a thing's sightings that are fused: more show nothing new."""
NEAR_M = 10.0
"""Sightings farther apart along x or y are not compared: no car is so long."""

IsSame = Callable[[Row, Row], bool]
"""Whether two sightings are of one thing; asked in either order."""


def digest_of(*names: str | None) -> str:
    """An id that follows from some names."""
    return digest_text(canonical_json(list(names)))[:ID_LENGTH]


def enter_sightings(store: Store, rows: Sequence[Row], is_same: IsSame) -> list[str]:
    """Enter the sightings of a run, all but their `asset_id`; returns the ids of their assets.

    Sightings that are known are replaced; the same ones again change nothing.

    Raises:
        ConflictError: other writers won every attempt.
        StorageError: a table cannot be written.
    """
    with store.alone(LOCK):
        names = SIGHTINGS.arrow.names
        new: list[Row] = [{name: row.get(name) for name in names} for row in rows]
        known = store.tables.arrow(SIGHTINGS.name, where=_in_question(new))
        is_old = _is_in(known, "sighting_id", {row["sighting_id"] for row in new})
        old = known.filter(pa.array(is_old)).to_pylist()
        others = _leaving(_candidates(known, new), new)
        groups = _Groups()
        for row in old:
            groups.join(row["sighting_id"], row["asset_id"])
        for number, row in enumerate(new):
            for other in (*others, *new[:number]):
                if is_same(row, other):
                    groups.join(row["sighting_id"], other["asset_id"] or other["sighting_id"])
        before = _stored(store, "asset_id", groups.names)
        members = _leaving(before, new)
        for row in members:
            groups.join(row["sighting_id"], row["asset_id"])
        entered = _named([*new, *members], groups)
        _write(store, before, entered)
        ids = {row["sighting_id"]: row["asset_id"] for row in entered}
        return [ids[row["sighting_id"]] for row in new]


def forget_sightings(store: Store, column: str, values: Iterable[str]) -> None:
    """Take sightings out whose run or artefact (`column`) is gone; assets without any go too."""
    with store.alone(LOCK):
        gone = _stored(store, column, values)
        if not gone:
            return
        before = _stored(store, "asset_id", {row["asset_id"] for row in gone})
        names = {row["sighting_id"] for row in gone}
        gone += [row for row in before if names & set(row["fused_from"] or ())]
        names |= {row["sighting_id"] for row in gone}
        store.tables.delete(SIGHTINGS.name, "sighting_id", sorted(names))
        members, groups = _leaving(before, gone), _Groups()
        for row in members:
            groups.join(row["sighting_id"], row["asset_id"])
        _write(store, before, _named(members, groups))


def to_fuse(store: Store, asset_ids: Iterable[str]) -> dict[str, list[Row]]:
    """The sightings that may be fused, of those assets that have two or more, the best first."""
    groups: dict[str, list[Row]] = {}
    for row in _stored(store, "asset_id", asset_ids):
        groups.setdefault(row["asset_id"], []).append(row)
    chosen = {name: _to_fuse(rows) for name, rows in groups.items()}
    return {name: rows for name, rows in chosen.items() if len(rows) > 1}


def enter_fused(store: Store, made: Mapping[str, tuple[Sequence[Row], Row | None]]) -> list[str]:
    """Enter what was fused in place of what stood; returns the assets of which something stands.

    Args:
        store: where.
        made: by asset, the sightings as `to_fuse` gave them and the row of what was made of them,
            all but the ids of sighting and asset; None where they are not of one thing. Where the
            sightings are others by now nothing is entered: whoever entered those fuses them.

    Raises:
        ConflictError: other writers won every attempt.
        StorageError: a table cannot be written.
    """
    with store.alone(LOCK):
        before = _stored(store, "asset_id", made)
        entered: list[Row] = []
        gone: list[Row] = []
        for name, (members, row) in made.items():
            own = [one for one in before if one["asset_id"] == name]
            if _to_fuse(own) != list(members):
                continue
            if row is not None:
                known = {column: row.get(column) for column in SIGHTINGS.arrow.names}
                ids = {"asset_id": name, "sighting_id": digest_of("fused", name)}
                entered.append(known | ids)
            gone += [one for one in own if one["fused_from"] is not None]
        gone = _leaving(gone, entered)
        store.tables.delete(SIGHTINGS.name, "sighting_id", [row["sighting_id"] for row in gone])
        others = _leaving(_leaving(before, entered), gone)
        _write(store, before, [*others, *entered])
        return [row["asset_id"] for row in entered]


def _to_fuse(rows: Sequence[Row]) -> list[Row]:
    """The best sighting of each occurrence, the best first: two runs of a log show the same."""
    ranked = sorted((row for row in rows if _may_be_fused(row)), key=how_well)
    best = {row["occurrence_id"]: row for row in ranked}
    return sorted(best.values(), key=how_well, reverse=True)[:MOST_FUSED]


def _may_be_fused(row: Row) -> bool:
    return row["kind"] == "actor" and row["seen_share"] is not None and row["fused_from"] is None


def find_asset(store: Store, name: str) -> Row:
    """The asset of an id, of a unique prefix of one, or of the `occurrence_id` of a sighting.

    Raises:
        UnknownRecordError: there is none, or several begin so.
    """
    # a sighting's own id finds what was merged into another asset
    for table, column in ((ASSETS.name, "asset_id"), (SIGHTINGS.name, "occurrence_id")):
        rows = store.tables.arrow(table, columns=sorted({"asset_id", column}))
        begins = pc.starts_with(rows[column], pattern=name)
        found = set(rows.filter(begins)["asset_id"].to_pylist()) if name else set()
        found = {name} if name in found else found
        if len(found) == 1:
            return store.tables.row(ASSETS.name, found.pop())
        if found:
            some = ", ".join(sorted(found)[:5])
            raise UnknownRecordError(f"asset {name!r} is not unique: {some}")
    raise UnknownRecordError(
        f"no asset {name!r} in {store.name}: `assets list` names them, `assets publish` makes them"
    )


def sightings_of(store: Store, asset_id: str) -> list[Row]:
    """Every time that the asset was seen, the best first."""
    return sorted(_stored(store, "asset_id", [asset_id]), key=how_well, reverse=True)


def how_well(sighting: Row) -> tuple[bool, float, str]:
    """Sorts sightings by how well they serve, the best last.

    What was published before vehicles were made whole has no `seen_share`, a score of another
    kind, and serves last.
    """
    is_whole = sighting.get("seen_share") is not None
    return is_whole, sighting["score"] or 0.0, sighting["sighting_id"]


class _Groups:
    """Names that belong together (disjoint sets)."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}

    @property
    def names(self) -> set[str]:
        """All that were ever joined."""
        return set(self._parents)

    def join(self, one: str, other: str) -> None:
        """Let two groups be one."""
        self._parents[self.root(one)] = self.root(other)

    def root(self, name: str) -> str:
        """The name that stands for a group."""
        while (parent := self._parents.setdefault(name, name)) != name:
            self._parents[name] = name = self._parents[parent]
        return name


def _in_question(new: Sequence[Row]) -> dict[str, set[str]]:
    """Values of columns without which a known sighting can be of nothing new."""
    return {
        "sighting_id": {row["sighting_id"] for row in new},
        "occurrence_id": {row["occurrence_id"] for row in new},
        "actor_id": _unique_ids(new),
        "frame": {row["frame"] for row in new if row["is_moving"] is False},
    }


def _unique_ids(rows: Sequence[Row]) -> set[str]:
    ids = (row["actor_id"] or "" for row in rows)
    return {name for name in ids if len(name) >= LEAST_ID_LENGTH}


def _candidates(known: pa.Table, new: Sequence[Row]) -> list[Row]:
    """The known sightings that one of some new ones may be of the same thing as."""
    mask = _is_in(known, "occurrence_id", {row["occurrence_id"] for row in new})
    mask |= _is_in(known, "actor_id", _unique_ids(new))
    x_m, y_m = (known[name].to_numpy() for name in ("x_m", "y_m"))
    standing = [row for row in new if row["is_moving"] is False]
    here = np.flatnonzero(_is_in(known, "frame", {row["frame"] for row in standing}))
    for row in standing:
        near = (abs(x_m[here] - row["x_m"]) < NEAR_M) & (abs(y_m[here] - row["y_m"]) < NEAR_M)
        mask[here[near]] = True
    return known.filter(pa.array(mask)).to_pylist()


def _named(rows: Sequence[Row], groups: _Groups) -> list[Row]:
    """The rows with the ids of their assets."""
    least: dict[str, str] = {}
    for row in rows:
        root = groups.root(row["sighting_id"])
        least[root] = min(least.get(root, row["occurrence_id"]), row["occurrence_id"])
    return [row | {"asset_id": least[groups.root(row["sighting_id"])]} for row in rows]


def _write(store: Store, before: Sequence[Row], entered: Sequence[Row]) -> None:
    """Bring both tables from what the sightings of some assets were to what they are now."""
    stood = {row["sighting_id"]: row for row in before}
    changed = [row for row in entered if stood.get(row["sighting_id"]) != row]
    store.tables.merge(SIGHTINGS.name, changed)
    # what wears a style names the asset that it is a style of, which may be another one by now
    styled = _stored(store, "base_id", {row["occurrence_id"] for row in entered})
    ids = {row["asset_id"] for row in (*entered, *styled)}
    members: dict[str, list[Row]] = {name: [] for name in ids}
    for row in _stored(store, "asset_id", ids):
        members[row["asset_id"]].append(row)
    bases = {row["base_id"] for rows in members.values() for row in rows if row["base_id"]}
    base_of = {
        row["occurrence_id"]: row["asset_id"] for row in _stored(store, "occurrence_id", bases)
    }
    stood = {row["asset_id"]: row for row in _stored(store, "asset_id", ids, ASSETS.name)}
    rows = [_asset_row(found, base_of) for found in members.values()]
    store.tables.merge(ASSETS.name, [row for row in rows if stood.get(row["asset_id"]) != row])
    gone = {row["asset_id"] for row in before} - ids
    store.tables.delete(ASSETS.name, "asset_id", sorted(gone))


def _asset_row(members: Sequence[Row], base_of: dict[str, str]) -> Row:
    """The row of an asset; the sighting of the best score serves."""
    best = max(members, key=how_well)
    bases = sorted({base_of[row["base_id"]] for row in members if row["base_id"] in base_of})
    taken = {column.name: best.get(column.name) for column in ASSETS.columns}
    return taken | {
        "scene_ids": sorted({row["scene_id"] for row in members}),
        "num_sightings": sum(row["fused_from"] is None for row in members),
        "derived_from": bases[0] if bases else None,
    }


def _stored(
    store: Store, column: str, values: Iterable[str], table: str = SIGHTINGS.name
) -> list[Row]:
    """The rows of a table in the store with one of these values in a column."""
    return store.tables.rows(table, where={column: set(values)})


def _is_in(table: pa.Table, column: str, values: Iterable[str]) -> np.ndarray:
    """Which rows have one of these values in a column."""
    found = pc.is_in(table[column], value_set=pa.array(values, pa.string()))
    return found.to_numpy(zero_copy_only=False).astype(bool)


def _leaving(rows: Sequence[Row], out: Sequence[Row]) -> list[Row]:
    """The sightings that are none of some others."""
    ids = {row["sighting_id"] for row in out}
    return [row for row in rows if row["sighting_id"] not in ids]
