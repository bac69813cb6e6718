"""Rows of the catalog and their deterministic ids."""

import json
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Literal

from catalog.artefacts import ArtefactRef, Manifest
from catalog.digests import canonical_json, digest_text
from catalog.errors import CatalogError

RunStatus = Literal["running", "complete", "failed", "interrupted"]
RUN_ID_LENGTH = 16


def run_id_of(scene_digest: str, parameters: Any, source_digest: str) -> str:  # noqa: ANN401
    """The id of a run: the same scene content, parameters and code make the same run."""
    return digest_text(canonical_json([scene_digest, parameters, source_digest]))[:RUN_ID_LENGTH]


@dataclass(frozen=True, kw_only=True)
class SceneRecord:
    """A row of the table `scenes`; the columns say what each field means."""

    scene_id: str
    dataset: str
    sequence: str
    content_digest: str
    licence: str
    num_frames: int
    num_views: int
    cameras: tuple[str, ...]
    num_points: int
    num_actors: int
    num_moving_actors: int
    duration_s: float
    num_bytes: int
    software_version: str

    def row(self) -> dict[str, Any]:
        """The row."""
        return {**asdict(self), "cameras": list(self.cameras)}


@dataclass(frozen=True, kw_only=True)
class RunRecord:
    """A row of the table `runs`; the columns say what each field means."""

    run_id: str
    scene_id: str
    scene_digest: str
    preset: str
    painter: str
    parameters: str
    source_digest: str
    software_version: str
    started_at: datetime
    device: str
    status: RunStatus = "running"
    error: str | None = None
    finished_at: datetime | None = None
    stage_seconds: str | None = None
    peak_memory_bytes: int | None = None
    num_gaussians: int | None = None
    artefacts: tuple[str, ...] = ()
    result: str | None = None
    report: str | None = None
    derived_from: str | None = None
    change: str | None = None

    def row(self) -> dict[str, Any]:
        """The row."""
        finished_at = self.finished_at
        return {
            **asdict(self),
            "artefacts": list(self.artefacts),
            "seconds": (finished_at - self.started_at).total_seconds() if finished_at else None,
            "host": platform.node(),
        }


@dataclass(frozen=True, kw_only=True)
class MetricRecord:
    """A row of the table `metrics`; the columns say what each field means."""

    run_id: str
    scene_id: str
    protocol: str
    trajectory: str
    variant: str
    name: str
    value: float | None
    reason: str | None = None
    by_view: Mapping[str, float | None] | None = None

    def row(self) -> dict[str, Any]:
        """The row."""
        names = [self.run_id, self.protocol, self.trajectory, self.variant, self.name]
        by_view = None if self.by_view is None else canonical_json(self.by_view)
        row = {**asdict(self), "by_view": by_view}
        return {"metric_id": digest_text(canonical_json(names)), **row}


def artefact_row(ref: ArtefactRef, manifest: Manifest) -> dict[str, Any]:
    """The row of the table `artefacts` for a stored artefact."""
    return {
        "artefact_id": ref.artefact_id,
        "kind": ref.kind,
        "digest": ref.digest,
        "inputs": canonical_json(manifest.inputs),
        "config": canonical_json(manifest.config),
        "source_digest": manifest.source_digest,
        "starts": list(manifest.starts),
        "num_bytes": manifest.num_bytes,
        "seconds": manifest.seconds,
        "created_at": datetime.fromisoformat(manifest.created_at),
        "summary": canonical_json(manifest.summary),
        "software_version": manifest.software_version,
    }


def metric_rows(records: Iterable[MetricRecord]) -> list[dict[str, Any]]:
    """Rows of many metrics."""
    return [record.row() for record in records]


def json_of(row: dict[str, Any], column: str) -> Any:  # noqa: ANN401 - any JSON value
    """What a column with JSON text holds.

    Raises:
        CatalogError: it is no JSON.
    """
    try:
        return json.loads(row[column])
    except (TypeError, ValueError):
        name = next(iter(row.values()))
        raise CatalogError(f"{column} of {name} is no JSON: its row is damaged") from None
