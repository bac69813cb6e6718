"""A manifest of figures: fleets, and tables of what became of them for README and docs.

A cell is what its row, its column and its table say together: which fleet, configuration and
scenes, which variant, which figures. It comes from outside, as a fleet's manifest does, which its
fleets are in full.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StrictStr, ValidationError, model_validator

from flows.fleet.manifest import STORED, SYNTHETIC, Manifest, Name, SceneName, range_of, read_toml
from flows.measure.figures import AT_END, COSTS, check_figure, measured_as
from lidarpainter_models.errors import ConfigError
from tasks.specs import street_id

Variant = Literal["final", "unpainted", "view-time"]
Label = Annotated[StrictStr, Field(pattern=r"^[^|\n]*$")]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Choice(_Strict):
    """What a table, a column or a row says of its cells."""

    fleet: Name | None = None
    configuration: Name | None = None
    """Absent where the fleet has none."""
    scene: SceneName | None = None
    """Absent: the mean over all scenes of the fleet; over seeds always."""
    variant: Variant | None = None
    """`final` if absent."""
    figures: Annotated[tuple[StrictStr, ...], Field(min_length=1)] | None = None
    """Shown with strokes between; see `figures.metric_names` and `figures.DERIVED`."""


class Column(Choice):
    """A column."""

    label: Label


class Line(Choice):
    """A row."""

    label: Label
    columns: tuple[Label, ...] | None = None
    """Those where it has a cell; absent: all."""


class Table(Choice):
    """A table of a page."""

    name: Name
    corner: Label = ""
    """Above the labels of the rows."""
    row: Annotated[tuple[Line, ...], Field(min_length=1)]
    column: Annotated[tuple[Column, ...], Field(min_length=1)]


class Fleet(Manifest):
    """A fleet whose points tables show."""

    missing: StrictStr = ""
    """What brings its stored scenes into the store."""

    @model_validator(mode="after")
    def _needs_no_folder(self) -> Self:
        if any(source.dataset not in (STORED, SYNTHETIC) for source in self.source):
            raise ValueError(f"a source of figures is {STORED} or {SYNTHETIC}")
        return self

    @property
    def scenes(self) -> tuple[str, ...]:
        """All that its sources name."""
        found: list[str] = []
        for source in self.source:
            found += source.scenes or map(street_id, range_of(source.seeds or "0:0"))
        return tuple(found)

    @property
    def ways(self) -> tuple[str, ...]:
        """Names of its configurations, or its own where it has none."""
        return tuple(way.name for way in self.configuration) or (self.name,)


class FigureManifest(_Strict):
    """All tables, and the fleets behind them."""

    pages: Annotated[tuple[StrictStr, ...], Field(min_length=1)]
    """Files with tables, from the folder of the manifest, as is the record."""
    record: StrictStr
    fleet: Annotated[tuple[Fleet, ...], Field(min_length=1)]
    table: Annotated[tuple[Table, ...], Field(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One cell of a table: the mean over its points of each of its figures."""

    table: str
    fleet: str
    points: tuple[str, ...]
    """Names of points."""
    variant: Variant
    figures: tuple[str, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """What its figures are called in the record, costs by what they are derived of."""
        names = [measured_as(figure) for figure in self.figures]
        return tuple(name if name in COSTS else f"{self.variant} {name}" for name in names)


def read_figure_manifest(path: Path) -> FigureManifest:
    """Read and check a manifest of figures.

    Raises:
        ConfigError: it cannot be read, or a table asks for what no fleet has.
    """
    values = read_toml(path)
    try:
        manifest = FigureManifest.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise ConfigError(f"{path}: {place}: {first['msg']}") from None
    for kind, names in (
        ("fleet", [fleet.name for fleet in manifest.fleet]),
        ("table", [table.name for table in manifest.table]),
    ):
        if len(set(names)) < len(names):
            raise ConfigError(f"{path}: two of [[{kind}]] have one name")
    try:
        for table in manifest.table:
            cells_of(manifest, table)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return manifest


def point_name(fleet: str, way: str, scene: str, seed: int) -> str:
    """What a point is called in the record."""
    return f"{fleet} {way} {scene} seed {seed}"


def cells_of(manifest: FigureManifest, table: Table) -> dict[tuple[int, int], Cell]:
    """The cells of a table by the numbers of row and column, from 0; some may be empty.

    Raises:
        ConfigError: a cell asks for what no fleet has, or a row names no column.
    """
    fleets = {fleet.name: fleet for fleet in manifest.fleet}
    labels = {column.label for column in table.column}
    for row in table.row:
        if unknown := set(row.columns or ()) - labels:
            raise ConfigError(
                f"table {table.name}, row {row.label!r}: no column {', '.join(unknown)}"
            )
    return {
        (i, j): _cell(fleets, table, row, column)
        for i, row in enumerate(table.row)
        for j, column in enumerate(table.column)
        if row.columns is None or column.label in row.columns
    }


def _cell(fleets: Mapping[str, Fleet], table: Table, row: Line, column: Column) -> Cell:
    place = f"table {table.name}, row {row.label!r}, column {column.label!r}"

    def chosen(name: str) -> Any:  # noqa: ANN401 - whatever the field holds
        found = [getattr(one, name) for one in (row, column, table)]
        return next((value for value in found if value is not None), None)

    fleet = fleets.get(chosen("fleet") or "")
    if fleet is None:
        raise ConfigError(f"{place}: no fleet {chosen('fleet')!r}, there is {', '.join(fleets)}")
    way = chosen("configuration") or fleet.name
    if way not in fleet.ways:
        raise ConfigError(f"{place}: no configuration {way!r}, there is {', '.join(fleet.ways)}")
    scenes = (chosen("scene"),) if chosen("scene") else fleet.scenes
    if unknown := set(scenes) - set(fleet.scenes):
        raise ConfigError(f"{place}: fleet {fleet.name} has no scene {', '.join(unknown)}")
    figures = chosen("figures") or ()
    if not figures:
        raise ConfigError(f"{place}: neither row nor column says which figures")
    for figure in figures:
        check_figure(figure)
        if measured_as(figure) in COSTS and chosen("variant") not in (None, AT_END):
            raise ConfigError(f"{place}: {figure} is of a whole run, of no variant")
    names = tuple(point_name(fleet.name, way, *one) for one in product(scenes, fleet.fit_seeds))
    return Cell(
        table=table.name,
        fleet=fleet.name,
        points=names,
        variant=chosen("variant") or AT_END,
        figures=tuple(figures),
    )
