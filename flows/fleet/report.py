"""The page about a fleet: how fast it went, what failed and why, what it cost, how good it is."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from statistics import median, quantiles

import lidarpainter_models
from catalog.artefacts import ArtefactRef
from catalog.errors import CatalogError
from catalog.fleets import FleetLedger
from catalog.points import FINAL
from catalog.retries import by_cause
from catalog.tables import Row
from flows.fleet.manifest import Budget
from flows.fleet.status import counts_of, forecast_error
from lidarpainter_models.errors import DataError
from lidarpainter_models.export.pictures import WorstView, read_beside
from lidarpainter_models.export.report import Cell, Plot, Report, Table
from tasks.reconstruction.report import WORST_FILE

HOUR_S, GIGABYTE, GIBIBYTE = 3600.0, 1e9, 2.0**30
NUM_PICTURED = 3
"""Scenes shown of the worst, and of the slowest."""
MOST_ROWS = 50
"""Rows of a table at most; those beyond are counted."""
MOST_SCENES = 10
QUALITY = ("psnr", "ssim", "lpips")
RUNNING_MEDIAN = 9
"""Attempts whose errors are taken together in the chart of the forecast."""


@dataclass(frozen=True, kw_only=True)
class FleetRecord:
    """What the catalog knows of a fleet."""

    ledger: FleetLedger
    fleet: str

    @cached_property
    def rows(self) -> list[Row]:
        """The sequences of the fleet, in the order of the manifest."""
        return self.ledger.rows(self.fleet)

    @cached_property
    def repeated(self) -> set[str]:
        """Scenes that it makes in several ways."""
        counts = Counter(row["scene_id"] for row in self.rows)
        return {scene for scene, count in counts.items() if count > 1}

    @cached_property
    def attempts(self) -> list[Row]:
        """The attempts at sequences of the fleet, by the time of their end."""
        return self.ledger.attempts(self.fleet)

    @cached_property
    def quality(self) -> dict[str, dict[str, float]]:
        """Figures of held-out views after the last round, by run and name."""
        runs = {row["run_id"] for row in self.rows if row["run_id"]}
        found: dict[str, dict[str, float]] = {}
        for row in self.ledger.store.tables.rows("metrics", where={"run_id": runs}):
            is_shown = row["protocol"] == "recorded" and row["variant"] in FINAL
            if is_shown and row["name"] in QUALITY and row["value"] is not None:
                found.setdefault(row["run_id"], {})[row["name"]] = row["value"]
        return found

    @cached_property
    def money_per_hour(self) -> float | None:
        """What its manifest says of a worker's hour."""
        return Budget.model_validate_json(self.rows[0]["budget"]).money_per_hour

    def psnr(self, row: Row) -> float | None:
        """PSNR of the run of a sequence on held-out views, in dB; None where it was not scored."""
        return self.quality.get(row["run_id"] or "", {}).get("psnr")

    def picture(self, row: Row, title: str) -> WorstView | None:
        """The worst view of the run of a sequence; None where no report was made of it."""
        store = self.ledger.store
        with suppress(CatalogError, DataError):
            refs = map(ArtefactRef.of_id, store.run(row["run_id"])["artefacts"])
            report = next((ref for ref in refs if ref.kind == "report"), None)
            if report is not None:
                return read_beside(store.artefacts.files(report) / WORST_FILE, title)
        return None


def fleet_page(ledger: FleetLedger, fleet: str) -> Report:
    """The page.

    Raises:
        UnknownRecordError: there is no such fleet.
    """
    record = FleetRecord(ledger=ledger, fleet=fleet)
    judged = [row for row in record.rows if record.psnr(row) is not None]
    worst = sorted(judged, key=lambda row: record.psnr(row) or 0.0)
    made = [row for row in record.rows if row["run_id"]]
    slowest = sorted(made, key=lambda row: -(row["seconds"] or 0.0))
    shown = [("worst", row) for row in worst[:NUM_PICTURED]]
    shown += [("slowest", row) for row in slowest[:NUM_PICTURED]]
    quality = {
        name: [one[name] for one in record.quality.values() if name in one] for name in QUALITY
    }
    pictures = [record.picture(row, f"{what}: {_facts(record, row)}") for what, row in shown]
    return Report(
        title=f"Fleet {fleet}",
        summary=[_course(record), _spent(record)],
        verdict=_verdict(record),
        worst=[one for one in pictures if one is not None],
        worst_title="Worst and slowest scenes",
        tables=[
            *_failures(record),
            _causes(record),
            _distribution("Quality of held-out views", quality),
            _distribution("The forecast: how far off, as a share of what it took", _errors(record)),
            _scenes("Worst scenes", record, worst),
            _scenes("Slowest scenes", record, slowest),
        ],
        plots=_plots(record),
        facts={
            "Provenance": {
                "store": ledger.store.name,
                "software": f"lidarpainter {lidarpainter_models.__version__}",
            }
        },
    )


def _name(record: FleetRecord, row: Row) -> str:
    """A sequence as people tell it from others of its fleet."""
    if row["scene_id"] not in record.repeated:
        return str(row["scene_id"])
    seed = f"seed {row['fit_seed']}" if row["fit_seed"] else None
    cameras = ",".join(row["cameras"]) if row["cameras"] else None
    parts = (row["scene_id"], row["configuration"], seed, cameras)
    return ", ".join(part for part in parts if part)


def _facts(record: FleetRecord, row: Row) -> str:
    psnr = record.psnr(row)
    quality = [] if psnr is None else [f"{psnr:.1f} dB"]
    return ", ".join([_name(record, row), *quality, f"{row['seconds'] or 0.0:.0f} s"])


def _course(record: FleetRecord) -> str:
    counts = counts_of(record.rows)
    states = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    text = f"{len(record.rows)} sequences: {states}."
    if not record.attempts:
        return f"{text} Nobody has begun."
    began = min(row["started_at"] for row in record.attempts)
    hours = (record.attempts[-1]["ended_at"] - began).total_seconds() / HOUR_S
    workers = len({row["worker"] for row in record.attempts})
    return (
        f"{text} {len(record.attempts)} attempts by {workers} workers from {began:%Y-%m-%d %H:%M} "
        f"UTC on, over {hours:.2f} h: {counts['done'] / max(hours, 1e-9):.1f} done an hour."
    )


def _spent(record: FleetRecord) -> str:
    sums = {name: _sum(record.attempts, name) for name in ("seconds", "cpu_seconds", "num_bytes")}
    hours = sums["seconds"] / HOUR_S
    price = record.money_per_hour
    money = "" if price is None else f"; {hours * price:.2f} at {price:g} an hour of a worker"
    return (
        f"It took {hours:.2f} hours of workers, {sums['cpu_seconds'] / HOUR_S:.2f} CPU hours, "
        f"and stored {sums['num_bytes'] / GIGABYTE:.2f} GB{money}."
    )


def _verdict(record: FleetRecord) -> list[str]:
    counts = counts_of(record.rows)
    left = counts["waiting"] + counts["running"]
    amiss = counts["failed"] + counts["set-aside"]
    sentences = [f"Not over: {left} sequences are left."] if left else []
    if amiss:
        sentences.append(f"{counts['failed']} failed, {counts['set-aside']} set aside; see below.")
    elif not left:
        sentences.append("Good: every sequence is done.")
    found = [one["psnr"] for one in record.quality.values() if "psnr" in one]
    if found:
        sentences.append(
            f"Held-out views: median {median(found):.1f} dB, worst scene {min(found):.1f} dB."
        )
    error = forecast_error(record.attempts)
    if error is not None:
        sentences.append(f"The forecast was off by {error:.0%} (median).")
    return sentences


def _failures(record: FleetRecord) -> list[Table]:
    amiss = [row for row in record.rows if row["state"] in ("failed", "set-aside")]
    if not amiss:
        return []
    cells: list[list[Cell]] = [
        [_name(record, row), row["state"], row["cause"], row["attempts"], row["reason"]]
        for row in amiss
    ]
    columns = ["sequence", "state", "cause", "attempts", "reason"]
    return [_table("What is not there, and why", columns, cells)]


def _causes(record: FleetRecord) -> Table:
    """Attempts by how they ended."""
    cells: list[list[Cell]] = []
    for cause, rows in by_cause(record.attempts).items():
        hours, price = _sum(rows, "seconds") / HOUR_S, record.money_per_hour
        cells.append(
            [
                cause,
                len(rows),
                hours,
                _sum(rows, "cpu_seconds") / HOUR_S,
                max((row["peak_memory_bytes"] or 0 for row in rows), default=0) / GIBIBYTE,
                _sum(rows, "num_bytes") / GIGABYTE,
                None if price is None else hours * price,
            ]
        )
    columns = ["ended as", "attempts", "h", "CPU h", "most memory, GiB", "stored, GB", "money"]
    return _table("Attempts and what they cost", columns, cells)


def _errors(record: FleetRecord) -> dict[str, list[float]]:
    """Shares by which predictions of attempts that did their work were off."""
    targets = {"seconds": "seconds", "memory": "memory_bytes", "bytes": "num_bytes"}
    found: dict[str, list[float]] = {}
    for name, column in targets.items():
        true = "peak_memory_bytes" if name == "memory" else column
        found[name] = [
            abs(row[f"predicted_{column}"] - row[true]) / row[true]
            for row in record.attempts
            if row["cause"] == "done" and row["effort"] and row[f"predicted_{column}"] and row[true]
        ]
    return found


def _distribution(title: str, found: Mapping[str, Sequence[float]]) -> Table:
    cells: list[list[Cell]] = []
    for name, values in found.items():
        if len(values) > 1:
            tenths = quantiles(values, n=10, method="inclusive")
            spread: list[Cell] = [min(values), tenths[0], median(values), tenths[8], max(values)]
            cells.append([name, *spread, len(values)])
    return _table(title, ["", "least", "10 %", "median", "90 %", "most", "of"], cells)


def _scenes(title: str, record: FleetRecord, rows: Sequence[Row]) -> Table:
    cells: list[list[Cell]] = [
        [
            _name(record, row),
            row["seconds"],
            row["attempts"],
            *(record.quality.get(row["run_id"], {}).get(name) for name in QUALITY),
            row["run_id"],
        ]
        for row in rows
    ]
    columns = ["scene", "s", "attempts", "PSNR, dB", "SSIM", "LPIPS", "run"]
    return _table(title, columns, cells, most=MOST_SCENES)


def _table(
    title: str, columns: Sequence[str], cells: Sequence[Sequence[Cell]], *, most: int = MOST_ROWS
) -> Table:
    left = len(cells) - most
    note = f"and {left} more: fleet status --json lists all" if left > 0 else ""
    return Table(title=title, columns=columns, rows=cells[:most], note=note)


def _plots(record: FleetRecord) -> list[Plot]:
    if not record.attempts:
        return []
    began = min(row["started_at"] for row in record.attempts)
    hours = [(row["ended_at"] - began).total_seconds() / HOUR_S for row in record.attempts]
    done, not_done, cpu = [0], [0], [0.0]
    for row in record.attempts:
        is_done = row["cause"] == "done"
        done.append(done[-1] + is_done)
        not_done.append(not_done[-1] + (not is_done))
        cpu.append(cpu[-1] + (row["cpu_seconds"] or 0.0) / HOUR_S)
    times = [0.0, *hours]
    psnr = sorted(one["psnr"] for one in record.quality.values() if "psnr" in one)
    shares = [(100 * (place + 0.5) / len(psnr), value) for place, value in enumerate(psnr)]
    errors = _errors(record)["seconds"]
    smooth = [
        (float(end), 100 * median(errors[max(end - RUNNING_MEDIAN, 0) : end]))
        for end in range(1, len(errors) + 1)
    ]
    plots = [
        Plot(
            title="Throughput",
            x_label="hours since the first attempt",
            y_label="attempts that ended",
            series={
                "done": list(zip(times, map(float, done), strict=True)),
                "otherwise": list(zip(times, map(float, not_done), strict=True)),
            },
        ),
        Plot(
            title="Cost",
            x_label="hours since the first attempt",
            y_label="CPU hours",
            series={"spent": list(zip(times, cpu, strict=True))},
        ),
        Plot(
            title="Quality",
            x_label="% of the scenes, worst first",
            y_label="PSNR, dB",
            series={"held-out views": shares},
        ),
        Plot(
            title="Forecast",
            x_label="attempts that did their work",
            y_label=f"error of seconds in %, median of the last {RUNNING_MEDIAN}",
            series={"predicted seconds": smooth},
        ),
    ]
    return [plot for plot in plots if any(len(line) > 1 for line in plot.series.values())]


def _sum(rows: Sequence[Row], name: str) -> float:
    return float(sum(row[name] or 0 for row in rows))
