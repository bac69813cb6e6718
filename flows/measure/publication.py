"""Make the runs that tables of figures ask for, and write the record and the pages.

What is done is not done again: runs are points of fleets, and a figure that a run does not have yet
is judged then. A table is written whole or left as it is; its figures are the catalog's alone.
"""

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from catalog.errors import CatalogError
from catalog.points import Point, points_of
from catalog.store import Store
from catalog.tables import Row
from flows.evaluate import VIEW_TIME, EvaluationRequest, evaluate_run
from flows.fleet.manifest import STORED
from flows.measure.figure_manifest import (
    Cell,
    FigureManifest,
    Fleet,
    Table,
    cells_of,
    point_name,
    read_figure_manifest,
)
from flows.measure.figures import COSTS, figure_of, measured_as, metric_names
from flows.measure.sweep import THREADS, make_points, undone
from flows.measure.tables import (
    Figures,
    MissingFigureError,
    read_pages,
    read_record,
    record_text,
    rendered,
    with_tables,
)
from lidarpainter_models.errors import ConfigError, LidarPainterError, SceneError
from lidarpainter_models.evaluation.score_tables import FLICKER, MARKINGS, NEURAD
from lidarpainter_models.storage.whole_files import write_whole
from tasks.evaluation.views import CROSS_CAMERA, PAPER
from tasks.machine import machine
from tasks.opened import open_scene

ON_REQUEST = {CROSS_CAMERA, FLICKER, MARKINGS, NEURAD}
"""Protocols that no run is judged by as it ends."""
DIGITS = 8
"""Significant digits of a figure in the record."""
CODE_DIGITS = 12
WRITTEN, LEFT = "written", "left as it was"


@dataclass(frozen=True, kw_only=True)
class Publisher:
    """How what is not there is made."""

    store: Store
    workers: int
    accept_stale: bool
    say: Callable[[str], None]
    weights: Mapping[str, Any] = field(default_factory=dict)
    """Weights of perceptual distances, as parameters of runs have them."""

    def publish(self, path: Path, only: Sequence[str] | None = None) -> dict[str, Any]:
        """Write the tables of a manifest, or only some of them, and their record.

        Returns:
            What `figures --json` prints: `tables` with `state` and `reason`, `record`, `pages`.

        Raises:
            ConfigError: the manifest, the record or a page cannot be used.
        """
        manifest = read_figure_manifest(path)
        pages = read_pages(manifest, path.parent)
        record_path = path.parent / manifest.record
        record = read_record(record_path)
        chosen = [table for table in manifest.table if only is None or table.name in only]
        if len(chosen) < len(only or ()):
            known = ", ".join(table.name for table in manifest.table)
            raise ConfigError(f"no table {', '.join(only or ())}, there is {known}")
        found, left = self._found(manifest, chosen, _runs_in(record))
        names = {table.name for table in manifest.table}
        kept = {name: figures for name, figures in record.items() if name in names}
        _write(record_path, record_text(kept | found))
        written = {
            table.name: rendered(manifest, table, found[table.name])
            for table in chosen
            if table.name in found
        }
        changed = [page for page, text in pages.items() if _write(page, with_tables(text, written))]
        return {
            "tables": {
                table.name: {
                    "state": WRITTEN if table.name in found else LEFT,
                    "reason": left.get(table.name),
                }
                for table in chosen
            },
            "record": str(record_path),
            "pages": list(map(str, changed)),
        }

    def _found(
        self, manifest: FigureManifest, tables: Sequence[Table], known: Figures
    ) -> tuple[dict[str, Figures], dict[str, str]]:
        """The figures of tables that are whole, and why others are not."""
        cells = {table.name: list(cells_of(manifest, table).values()) for table in tables}
        asked = [cell for found in cells.values() for cell in found]
        points: dict[str, Point] = {}
        reasons: dict[str, str] = {}
        for fleet in manifest.fleet:
            own = [cell for cell in asked if cell.fleet == fleet.name]
            if not own:
                continue
            made, why = self._points(fleet)
            if why is not None:
                reasons[fleet.name] = why
                self.say(f"{fleet.name}: {why}")
            if judge(self.store, made, own, weights=self.weights, say=self.say):
                made = _by_name(fleet, points_of(self.store, fleet.name)[0])
            points |= made
        found, left = {}, {}
        for name, own in cells.items():
            try:
                found[name] = self._figures(own, points, reasons, known)
            except MissingFigureError as error:
                left[name] = str(error)
        return found, left

    def _points(self, fleet: Fleet) -> tuple[dict[str, Point], str | None]:
        """The points of a fleet that are done, and why there are not all of them."""
        try:
            for source in fleet.source:
                for scene in (source.scenes or ()) if source.dataset == STORED else ():
                    open_scene(self.store, scene)
        except SceneError as error:
            hint = f"; {fleet.missing}" if fleet.missing else ""
            return {}, f"{error}{hint}"
        points, missing = make_points(
            fleet, self.store, workers=self.workers, accept_stale=self.accept_stale, say=self.say
        )
        return _by_name(fleet, points), undone(points, missing) if missing else None

    def _figures(
        self,
        cells: Sequence[Cell],
        points: Mapping[str, Point],
        reasons: Mapping[str, str],
        known: Figures,
    ) -> Figures:
        """What the record holds of a table."""
        figures: dict[str, dict[str, Any]] = {}
        for cell in cells:
            for name in cell.points:
                if name not in points:
                    raise MissingFigureError(reasons.get(cell.fleet, f"no point {name}"))
                point = points[name]
                entry = figures.setdefault(name, {**self._run(point.run_id, known), "figures": {}})
                for figure, key in zip(cell.figures, cell.keys, strict=True):
                    value = figure_of(point, measured_as(figure), cell.variant)
                    if value is None:
                        raise MissingFigureError(f"no {key} of {name}")
                    entry["figures"][key] = float(f"{value:.{DIGITS}g}")
        return figures

    def _run(self, run_id: str, known: Figures) -> dict[str, Any]:
        """Which run it was, when, by which code and on what, as told when it was first recorded."""
        if run_id in known:
            return dict(known[run_id])
        row: Row = self.store.run(run_id)
        is_here = row["host"] == platform.node()
        processor = machine(torch.device("cpu"))["processor"]
        return {
            "run": run_id,
            "version": row["software_version"],
            "code": row["source_digest"][:CODE_DIGITS],
            "date": f"{row['finished_at']:%Y-%m-%d}",
            "cpu": processor if is_here else "a processor that is not known",
            "threads": THREADS,
        }


def judge(
    store: Store,
    points: Mapping[str, Point],
    cells: Iterable[Cell],
    *,
    weights: Mapping[str, Any],
    say: Callable[[str], None],
) -> bool:
    """Judge points by what cells ask of them; whether there was anything to ask.

    Runs judge themselves by what they are judged by as they end. The rest is asked each time:
    what the judging code of now has judged before is taken as it is, what older code said is
    replaced.
    """
    asked: dict[tuple[str, str], bool] = {}
    for cell in cells:
        for name in cell.points:
            for protocol in _asked(points.get(name), cell):
                at_view_time = asked.get((name, protocol), False)
                asked[name, protocol] = at_view_time or cell.variant == VIEW_TIME
    for (name, protocol), is_painted in asked.items():
        say(f"{name}: judged by {protocol}{', painted at view time' * is_painted}")
        request = EvaluationRequest(
            run=points[name].run_id, protocol=protocol, is_painted=is_painted, changes=weights
        )
        try:
            evaluate_run(store, request)
        except (LidarPainterError, CatalogError) as error:
            say(f"{name}: {error}")
    return bool(asked)


def _by_name(fleet: Fleet, points: Iterable[Point]) -> dict[str, Point]:
    return {
        point_name(fleet.name, point.configuration, point.scene, point.seed): point
        for point in points
    }


def _asked(point: Point | None, cell: Cell) -> set[str]:
    """The protocols that a point is to be judged under for a cell."""
    if point is None:
        return set()
    asked = set()
    for figure in map(measured_as, cell.figures):
        protocols = {protocol for protocol, _, _ in metric_names(figure)}
        is_known = figure in COSTS or figure_of(point, figure, cell.variant) is not None
        asked |= protocols & ON_REQUEST
        if not is_known and protocols - ON_REQUEST:
            asked.add(PAPER)
    return asked


def _runs_in(record: Mapping[str, Figures]) -> dict[str, Mapping[str, Any]]:
    """What a record says of each of its runs."""
    return {
        entry["run"]: {name: value for name, value in entry.items() if name != "figures"}
        for figures in record.values()
        for entry in figures.values()
    }


def _write(path: Path, text: str) -> bool:
    """Write a file unless it holds this already; whether it was written."""
    if path.exists() and path.read_text("utf-8") == text:
        return False
    write_whole(path, text.encode())
    return True
