"""Rows of the catalog and their deterministic ids."""

import json
import platform
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


def metric_row(run_id: str, scene_id: str, variant: str, **measured: Any) -> dict[str, Any]:  # noqa: ANN401
    """The row of the table `metrics` for a number; `measured` has its other columns."""
    names = [run_id, measured["protocol"], measured["trajectory"], variant, measured["name"]]
    row = {"run_id": run_id, "scene_id": scene_id, "variant": variant, **measured}
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
