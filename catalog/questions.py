"""What people ask of a whole store: what is stale, what redoing it takes, what a scene has cost.

Answered from columns of tables alone, so that ten thousand scenes take a second. Artefacts that
start at the same symbols and ran the same code are judged together.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from catalog.artefacts import ArtefactRef, Manifest
from catalog.errors import CatalogError, IdentityError, UnknownRecordError
from catalog.explain import SCENE, CodeToday, changed_modules
from catalog.records import json_of
from catalog.retries import by_cause
from catalog.store import Store
from catalog.tables import Row

UNKNOWN_CODE = "code that is gone or was not recorded"
NEW_CONTENT = "the content of the scene"
ARTEFACT_COLUMNS = (
    *("artefact_id", "inputs", "source_digest", "starts"),
    *("seconds", "num_bytes", "summary"),
)
RUN_COLUMNS = (
    *("run_id", "scene_id", "parameters", "derived_from", "change"),
    *("status", "finished_at", "artefacts"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StaleRun:
    """The newest run of a scene, parameters and history, if today's code would make another."""

    scene_id: str
    run_id: str
    changed: tuple[str, ...]
    """Modules whose change began it, or what else did."""
    artefacts: Mapping[str, Mapping[str, float]]
    """What would be made anew, with the seconds, CPU seconds and bytes that it took."""

    def total(self, name: str) -> float:
        """Seconds, CPU seconds or bytes of it all."""
        return sum(cost[name] for cost in self.artefacts.values())


def stale_runs(store: Store, today: CodeToday) -> list[StaleRun]:
    """The stale ones of all newest runs, by scene."""
    rows = store.tables.arrow("artefacts", columns=ARTEFACT_COLUMNS).to_pylist()
    inputs = {row["artefact_id"]: json_of(row, "inputs") for row in rows}
    contents = {"", *store.tables.arrow("scenes", columns=["content_digest"])[0].to_pylist()}
    moved = [name for name, parts in inputs.items() if parts.get(SCENE, "") not in contents]
    changed = _changed(store, rows, today) | dict.fromkeys(moved, (NEW_CONTENT,))
    why = _with_heirs(inputs, changed)
    by_id = {row["artefact_id"]: row for row in rows}
    found = []
    for run in _newest(store.tables.arrow("runs", columns=RUN_COLUMNS).to_pylist()):
        stale = [name for name in run["artefacts"] or () if name in why]
        if not stale:
            continue
        one = StaleRun(
            scene_id=run["scene_id"],
            run_id=run["run_id"],
            changed=tuple(sorted({module for name in stale for module in why[name]})),
            artefacts={name: _sums([by_id[name]]) for name in stale},
        )
        found.append(one)
    return sorted(found, key=lambda one: (one.scene_id, one.run_id))


def cost_of(store: Store, scene_id: str) -> dict[str, Any]:
    """What a scene has cost: attempts of fleets by cause, and stages as they were computed.

    Money is the wall time of attempts at what the manifest of their fleet says of an hour; None
    where none says it. Stages that several runs share count once.

    Raises:
        UnknownRecordError: neither a run nor an attempt was about this scene.
    """
    attempts, runs = (
        store.tables.rows(table, where={"scene_id": [scene_id]}) for table in ("attempts", "runs")
    )
    if not attempts and not runs:
        raise UnknownRecordError(f"no run and no attempt of a scene {scene_id!r}")
    prices = _prices(store)
    names = {name for run in runs for name in run["artefacts"] or ()}
    made = store.tables.rows("artefacts", where={"artefact_id": names})
    kinds = sorted({row["kind"] for row in made})
    return {
        "scene": scene_id,
        "attempts": _spent(attempts, prices),
        "by_cause": {cause: _spent(ended, prices) for cause, ended in by_cause(attempts).items()},
        "stages": {kind: _sums(row for row in made if row["kind"] == kind) for kind in kinds},
        "stages_total": _sums(made),
        "runs": len(runs),
    }


def _changed(store: Store, rows: Sequence[Row], today: CodeToday) -> dict[str, tuple[str, ...]]:
    """The artefacts whose own code is not what it was, and the modules that changed."""
    groups: dict[tuple[tuple[str, ...], str], list[str]] = defaultdict(list)
    for row in rows:
        starts = row["starts"]
        if starts is None:  # a row of older software
            manifest = _manifest(store, row["artefact_id"])
            starts = manifest.starts if manifest else []
        groups[tuple(starts), row["source_digest"]].append(row["artefact_id"])
    found: dict[str, tuple[str, ...]] = {}
    for (starts, digest), names in groups.items():
        try:
            code = today(starts) if starts else None
        except IdentityError:
            code = None
        if code is not None and code.digest == digest:
            continue
        changed: Sequence[str] = ()
        if code is not None and (manifest := _manifest(store, names[0])):
            changed = changed_modules(manifest.code, code.modules)
        found |= dict.fromkeys(names, tuple(changed) or (UNKNOWN_CODE,))
    return found


def _manifest(store: Store, name: str) -> Manifest | None:
    """The manifest of an artefact, if it can be read: `verify` tells of damage."""
    with suppress(CatalogError):
        return store.artefacts.manifest(ArtefactRef.of_id(name))
    return None


def _with_heirs(
    inputs: Mapping[str, Mapping[str, str]], changed: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """These, and all that was made from them, with the modules that began it."""
    made_from: dict[str, list[str]] = defaultdict(list)
    for name, parts in inputs.items():
        for digest in parts.values():
            made_from[digest].append(name)
    found, waiting = dict(changed), list(changed)
    while waiting:
        name = waiting.pop()
        for heir in made_from[name.partition("/")[2]]:
            if heir not in found:
                found[heir] = found[name]
                waiting.append(heir)
    return found


def _newest(runs: Iterable[Row]) -> Iterable[Row]:
    """The newest of the complete runs of each scene with the same parameters and history."""
    by_id = {row["run_id"]: row for row in runs}
    newest: dict[tuple[str, str, tuple[str, ...]], Row] = {}
    for row in by_id.values():
        key = row["scene_id"], row["parameters"], _history(row, by_id)
        if row["status"] == "complete" and (
            key not in newest or row["finished_at"] > newest[key]["finished_at"]
        ):
            newest[key] = row
    return newest.values()


def _history(run: Row, by_id: Mapping[str, Row]) -> tuple[str, ...]:
    """All that a run was changed by, the last first; then a source that is gone, by its id."""
    found: list[str] = []
    row: Row | None = run
    while row is not None and (source := row["derived_from"]) is not None:
        found.append(row["change"] or "")
        row = by_id.get(source)
        if row is None:
            found.append(source)
    return tuple(found)


def _prices(store: Store) -> dict[str, float]:
    """Money per hour, by fleet."""
    arrow = store.tables.arrow("sequences", columns=("fleet", "budget"))
    fleets = arrow.group_by(["fleet", "budget"], use_threads=False).aggregate([]).to_pylist()
    budgets = {row["fleet"]: json_of(row, "budget") for row in fleets}
    return {
        name: one["money_per_hour"] for name, one in budgets.items() if one.get("money_per_hour")
    }


def _spent(attempts: Sequence[Row], prices: dict[str, float]) -> dict[str, Any]:
    """What some attempts took; memory is the largest."""
    priced = [row for row in attempts if row["fleet"] in prices]
    money = sum((row["seconds"] or 0.0) / 3600 * prices[row["fleet"]] for row in priced)
    return {
        "attempts": len(attempts),
        **{
            name: sum(row[name] or 0 for row in attempts)
            for name in ("seconds", "cpu_seconds", "num_bytes")
        },
        "peak_memory_bytes": max((row["peak_memory_bytes"] or 0 for row in attempts), default=0),
        "money": money if priced else None,
    }


def _sums(made: Iterable[Row]) -> dict[str, Any]:
    """What artefacts took when they were computed."""
    rows = list(made)
    return {
        "seconds": sum(row["seconds"] or 0.0 for row in rows),
        "cpu_seconds": sum(json_of(row, "summary").get("cpu_seconds", 0.0) for row in rows),
        "num_bytes": sum(row["num_bytes"] or 0 for row in rows),
    }
