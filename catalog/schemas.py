"""The catalog's tables: every column once, with its type, unit and meaning.

What becomes of what older and newer software stored, in tables and in manifests alike:

- Columns and fields are only ever added, and keep their meaning. An older row reads as null where
  it lacks a column (an older manifest as the default of the field), and the column is added to the
  table with the next row that is written.
- A column that is no longer listed here stays in tables that have it, and is not read.
- A manifest's version goes up with its fields; a version above one's own is refused, never
  overwritten. The digest of an artefact does not cover it: nothing is computed anew.
- Names of files count from the folder of the store. Rows of version 0.1 hold absolute ones, which
  are taken as they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pyarrow as pa

ColumnType = Literal["text", "integer", "number", "flag", "time", "texts"]

ARROW_TYPES: dict[ColumnType, pa.DataType] = {
    "text": pa.string(),
    "integer": pa.int64(),
    "number": pa.float64(),
    "flag": pa.bool_(),
    "time": pa.timestamp("us", tz="UTC"),
    "texts": pa.list_(pa.string()),
}


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    name: str
    type: ColumnType
    description: str
    unit: str = ""

    @property
    def arrow(self) -> pa.Field:
        """The Arrow field, with unit and description as metadata."""
        metadata = {"description": self.description, "unit": self.unit}
        return pa.field(self.name, ARROW_TYPES[self.type], metadata=metadata)


@dataclass(frozen=True, slots=True)
class TableSchema:
    """One table; its first column is the deterministic id that rows are merged on."""

    name: str
    description: str
    columns: tuple[Column, ...]

    @property
    def key(self) -> str:
        """Name of the id column."""
        return self.columns[0].name

    @property
    def arrow(self) -> pa.Schema:
        """The Arrow schema."""
        return pa.schema([column.arrow for column in self.columns])

    def rows_as_arrow(self, rows: Sequence[Mapping[str, Any]]) -> pa.Table:
        """Rows as they are written.

        Raises:
            ValueError: a row has a column that is not here, or two share an id.
        """
        names = set(self.arrow.names)
        for row in rows:
            if unknown := sorted(set(row) - names):
                raise ValueError(f"table {self.name} has no column {', '.join(unknown)}")
        if len({row[self.key] for row in rows}) != len(rows):
            raise ValueError(f"two rows for table {self.name} share a {self.key}")
        return pa.Table.from_pylist(list(rows), schema=self.arrow)


SCENES = TableSchema(
    "scenes",
    "Driving sequences in the store, in the canonical form.",
    (
        Column("scene_id", "text", "dataset/sequence"),
        Column("dataset", "text", "where the log comes from"),
        Column("sequence", "text", "name of the log in its dataset"),
        Column("content_digest", "text", "digest of everything the stored scene holds"),
        Column("licence", "text", "terms of the data"),
        Column("num_frames", "integer", "frames"),
        Column("num_views", "integer", "camera images"),
        Column("cameras", "texts", "names of the cameras"),
        Column("num_points", "integer", "LiDAR points of all sweeps"),
        Column("num_actors", "integer", "annotated tracks"),
        Column("num_moving_actors", "integer", "annotated tracks that move"),
        Column("duration_s", "number", "first frame to last frame", "s"),
        Column("num_bytes", "integer", "size on disk", "byte"),
        Column("software_version", "text", "version that last recorded it"),
    ),
)

RUNS = TableSchema(
    "runs",
    "Reconstructions, and runs derived from them: one row for one input, parameters and code.",
    (
        Column("run_id", "text", "digest of scene content, parameters and code"),
        Column("scene_id", "text", "dataset/sequence"),
        Column("scene_digest", "text", "content digest of the scene it was run on"),
        Column("preset", "text", "name of the preset it started from"),
        Column("painter", "text", "name of the painter, or none"),
        Column("parameters", "text", "all parameters, canonical JSON"),
        Column("status", "text", "running, complete, failed or interrupted"),
        Column("error", "text", "why it failed"),
        Column("started_at", "time", "when it was last started"),
        Column("finished_at", "time", "when it was last finished"),
        Column("seconds", "number", "wall time of the last start, start to end", "s"),
        Column("stage_seconds", "text", "wall time by stage as computed, JSON", "s"),
        Column("peak_memory_bytes", "integer", "largest resident memory of any stage", "byte"),
        Column("num_gaussians", "integer", "Gaussians of the final scene"),
        Column("device", "text", "what the fit ran on"),
        Column("host", "text", "machine it ran on"),
        Column("artefacts", "texts", "kind/digest of everything it made or reused"),
        Column("result", "text", "what the command that made it printed, JSON"),
        Column("report", "text", "file of the report, from the folder of the store"),
        Column("software_version", "text", "version of lidarpainter"),
        Column("source_digest", "text", "digest of the code of its stages"),
        Column("derived_from", "text", "run that it was changed from, or null"),
        Column("change", "text", "what was changed (kind, parameters), JSON, or null"),
    ),
)

ARTEFACTS = TableSchema(
    "artefacts",
    "What the stages made: content-addressed folders with a manifest.",
    (
        Column("artefact_id", "text", "kind/digest"),
        Column("kind", "text", "which stage made it"),
        Column("digest", "text", "digest of inputs, configuration and code"),
        Column("inputs", "text", "digest of every input by its part, JSON"),
        Column("config", "text", "configuration of the stage, canonical JSON"),
        Column("source_digest", "text", "digest of the code that made it"),
        Column("starts", "texts", "where that code starts, module:name"),
        Column("num_bytes", "integer", "size of its files", "byte"),
        Column("seconds", "number", "wall time of the process that finished it", "s"),
        Column("created_at", "time", "when it was finished"),
        Column("summary", "text", "what the stage said about its result, JSON"),
        Column("software_version", "text", "version of lidarpainter"),
    ),
)

METRICS = TableSchema(
    "metrics",
    "One number of one run: what was measured, against which truth, before or after painting.",
    (
        Column("metric_id", "text", "digest of the run and the four columns that name the number"),
        Column("run_id", "text", "the run"),
        Column("scene_id", "text", "dataset/sequence"),
        Column(
            "protocol",
            "text",
            "recorded, recorded-poses, truth, likeness (FID and KID), depth, neurad, cross-camera, "
            "markings, flicker, lidar or envelope",
        ),
        Column("trajectory", "text", "where the camera was: recorded, left-2m, up, ..."),
        Column("variant", "text", "unpainted, painted, refined (no painter), or view-time"),
        Column("name", "text", "what was measured: psnr, ssim, ..."),
        Column("value", "number", "the number, or null with a reason", "see name"),
        Column("reason", "text", "why there is no number"),
        Column(
            "by_view",
            "text",
            "of what the number is the mean (PSNR of each view) or the least (stretches), JSON",
            "see name",
        ),
    ),
)

PAINTERS = TableSchema(
    "painters",
    "Trained painters.",
    (
        Column("painter_id", "text", "digest of the weights file"),
        Column("name", "text", "name of the painter"),
        Column("path", "text", "weights file, from the folder of the store or else absolute"),
        Column("num_bytes", "integer", "size of the weights", "byte"),
        Column("record", "text", "how it was trained, JSON"),
        Column("created_at", "time", "when training ended"),
        Column("software_version", "text", "version of lidarpainter"),
    ),
)

SEQUENCES = TableSchema(
    "sequences",
    "What each fleet was asked for, and where it stands: one row for one way to make one scene.",
    (
        Column("sequence_id", "text", "digest of the fleet, the scene, the cameras and the way"),
        Column("fleet", "text", "name of the manifest"),
        Column("scene_id", "text", "dataset/sequence"),
        Column("cameras", "texts", "cameras to train on; null: all"),
        Column("configuration", "text", "name of the way it is made; null where there is one"),
        Column("fit_seed", "integer", "decides in which order a fit sees its views"),
        Column("position", "integer", "place in the manifest, from 0"),
        Column("priority", "integer", "higher ones go first"),
        Column("variants", "texts", "styles that are wanted of it"),
        Column("asked", "text", "source, preset, painter and settings, JSON"),
        Column("asked_digest", "text", "digest of that and of the weights"),
        Column("code_digest", "text", "digest of the code of its stages when it was asked for"),
        Column("budget", "text", "what a worker may take for it, JSON"),
        Column(
            "state",
            "text",
            "waiting, done, set-aside or failed; running is waiting with a live lease",
        ),
        Column("cause", "text", "of the last attempt; see attempts"),
        Column("reason", "text", "one line about the cause, where it is not done"),
        Column("run_id", "text", "the run that it became"),
        Column("tries", "integer", "attempts that failed and count, since it was asked for"),
        Column("attempts", "integer", "all attempts"),
        Column("seconds", "number", "wall time of all attempts", "s"),
        Column("not_before", "time", "earliest time of the next attempt"),
        Column("asked_at", "time", "when it was asked for; the last one tells the latest fleet"),
        Column("changed_at", "time", "when this row was written"),
        Column("fence", "integer", "number of this writing; a lower one is refused"),
    ),
)

ATTEMPTS = TableSchema(
    "attempts",
    "Every time that a worker took a sequence of a fleet into its hands.",
    (
        Column("attempt_id", "text", "sequence_id and fencing number of the lease"),
        Column("sequence_id", "text", "the sequence"),
        Column("fleet", "text", "name of the manifest"),
        Column("scene_id", "text", "dataset/sequence"),
        Column("run_id", "text", "the run that it became"),
        Column("worker", "text", "machine and process"),
        Column("started_at", "time", "when the lease was taken"),
        Column("ended_at", "time", "when the end was entered, or the last sign of life"),
        Column("seconds", "number", "wall time", "s"),
        Column("cpu_seconds", "number", "CPU time of all threads", "s"),
        Column("compile_seconds", "number", "CPU time of compiling kernels, part of that", "s"),
        Column("peak_memory_bytes", "integer", "largest resident memory", "byte"),
        Column("num_bytes", "integer", "size of what it made", "byte"),
        Column(
            "cause",
            "text",
            "why it ended: done, bad-input, disk-full, store-lost, api-lost, killed, memory, "
            "timeout, system, error, interrupted, cancelled or superseded",
        ),
        Column("reason", "text", "one line about the cause"),
        Column("effort", "text", "what its cost grows with, JSON; null unless it made all stages"),
        Column("predicted_seconds", "number", "what the forecast said before", "s"),
        Column("predicted_cpu_seconds", "number", "likewise, without compiling", "s"),
        Column("predicted_memory_bytes", "integer", "likewise", "byte"),
        Column("predicted_num_bytes", "integer", "likewise", "byte"),
        Column("software_version", "text", "version of lidarpainter"),
    ),
)

_SIGHTED = (
    Column("kind", "text", "actor, street, sky or trajectory"),
    Column("category", "text", "car, truck, pedestrian, ...; of a street or sky: its kind"),
    Column("name", "text", "what people call it"),
    Column("dataset", "text", "where the log comes from"),
    Column("licence", "text", "terms of the data, which hold for the asset too"),
    Column("run_id", "text", "run that shows it; of an asset: its best sighting's, as all below"),
    Column("actor_id", "text", "name of its track in the run, or null"),
    Column("style", "text", "words of the style that it wears, or null: as recorded"),
    Column("is_moving", "flag", "whether it moves in the scene, or null"),
    Column("length_m", "number", "size along its x; of a trajectory: the way gone", "m"),
    Column("width_m", "number", "size along its y", "m"),
    Column("height_m", "number", "size along its z", "m"),
    Column("num_gaussians", "integer", "Gaussians"),
    Column("num_points", "integer", "LiDAR points"),
    Column("num_views", "integer", "images that show it"),
    Column("nearest_m", "number", "least distance of a camera that shows it", "m"),
    Column("median_m", "number", "median distance of the cameras that show it", "m"),
    Column("pixels_per_m", "number", "of the image that shows it largest", "px/m"),
    Column("sides", "texts", "seen ones of front, rear, left, right and top"),
    Column("coverage", "number", "share of the upper half of directions seen, 0 to 1"),
    Column("seen_share", "number", "share of its Gaussians that images show, 0 to 1"),
    Column("mirrored_share", "number", "likewise: mirrored from its other side"),
    Column("guessed_share", "number", "likewise: guessed from vehicles of like shape"),
    Column("sharpness", "number", "detail of its fit against that of the images, 1: as much"),
    Column("psnr_db", "number", "PSNR of its fit against the images, inside its box", "dB"),
    Column("lpips", "number", "LPIPS inside its box, or null"),
    Column("judged_on", "text", "images of psnr_db and lpips: held-out or training"),
    Column("occlusion", "number", "share of its box hidden by others, mean of views, 0 to 1"),
    Column("score", "number", "how usable it is, 0 to 1; see docs/assets.md"),
    Column("artefact_id", "text", "where its files lie"),
    Column("folder", "text", "folder of its files in that artefact"),
    Column("thumbnail", "text", "picture in that artefact, azimuths side by side, or null"),
    Column("num_bytes", "integer", "size of its files", "byte"),
    Column("created_at", "time", "when its files were made"),
    Column("software_version", "text", "version of lidarpainter"),
    Column("fused_from", "texts", "sightings that it was fused from, or null: one alone"),
)
"""What an asset takes over from its best sighting."""

ASSETS = TableSchema(
    "assets",
    "What runs yield for use elsewhere: actors, blocks of street, skies, ways driven.",
    (
        Column("asset_id", "text", "least of the occurrence_id of its sightings"),
        *_SIGHTED,
        Column("scene_ids", "texts", "scenes that it was sighted in"),
        Column("num_sightings", "integer", "rows of sightings, without a fused one"),
        Column("derived_from", "text", "asset that it is a style of, or null"),
    ),
)

SIGHTINGS = TableSchema(
    "sightings",
    "Every time that a run shows an asset: several may be of one car, and one fused from them.",
    (
        Column("sighting_id", "text", "digest of the run, the kind and the name in the run"),
        Column("asset_id", "text", "what was seen"),
        Column("occurrence_id", "text", "digest of the scene, the kind, the name and the style"),
        Column("base_id", "text", "occurrence_id of the same without its style, or null"),
        Column("scene_id", "text", "dataset/sequence"),
        *_SIGHTED,
        Column("first_s", "number", "first time it is there, since the log begins", "s"),
        Column("last_s", "number", "last time it is there, since the log begins", "s"),
        Column("frame", "text", "global frame of its place: scenes that name the same share it"),
        Column("x_m", "number", "first place, in the global frame", "m"),
        Column("y_m", "number", "likewise", "m"),
        Column("z_m", "number", "likewise", "m"),
        Column("heading_rad", "number", "likewise, about z from x", "rad"),
    ),
)

_ALL = (SCENES, RUNS, ARTEFACTS, METRICS, PAINTERS, SEQUENCES, ATTEMPTS, ASSETS, SIGHTINGS)
TABLES: dict[str, TableSchema] = {table.name: table for table in _ALL}
