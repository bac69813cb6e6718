"""`lidarpainter assets`: what runs yield for use elsewhere."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from flows.cli.output import print_json, print_pairs, print_result, print_table, say_status
from flows.cli.rows import opened_row, row_cell, told_explanation
from flows.cli.shared_options import AsJson, described, named_run, parse_names
from lidarpainter_models.assets.import_formats import Axis, import_help
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from catalog.sql import CatalogSql
    from catalog.store import Store
    from catalog.tables import Row

ID_LENGTH = 12
"""Characters of an asset's id in a table, which name it to `assets show` too."""
MOST_SHOWN = 1000
"""Rows of a query's answer."""
SortName = Literal[  # `catalog.asset_queries.Sort`, known before anything is imported
    "score", "coverage", "psnr_db", "length_m", "num_views", "num_points", "created_at"
]

app = typer.Typer(help="Actors, streets and skies for use elsewhere.", no_args_is_help=True)

WORDS = f"""
file: File to import: {import_help()}.
import_.category: Category of what it shows, such as car.
size: Length, width and height in metres, as 4.5,1.8,1.5; the file is scaled to this length. As the
  file has it if absent.
up: Axis of the file that is up: x, -x, y, -y, z or -z; as the file says or its format has it if
  absent.
forward: Axis of the file along which its front is: x, -x, y, -y, z or -z; that of the longest
  horizontal side if absent.
import_.licence: Terms of the file, which hold for the asset.
runs: Runs, each by its id or the beginning of it, a scene such as pandaset/002 (its newest run), or
  latest (the newest run of all).
kind: Kind of the assets: actor, street, sky or trajectory; all if absent.
category: Category of the assets, as the data sets call it: car, truck, pedestrian, ...; or sedan, a
  car of a sedan's size. All if absent.
dataset: Dataset that the log comes from, such as pandaset; all if absent.
licence: Part of the name of the licence, such as CC BY; all if absent.
style: Word of the style that the asset was seen in, such as night, or recorded for none; all if
  absent.
scene: Scene that the asset was seen in, as dataset/sequence; all if absent.
sides: Sides that must all have been seen, with commas between: front, rear, left, right or top.
min_sides: The minimum number of sides that were seen, up to 5.
min_length: The minimum length in metres.
min_score: The minimum score, from 0 to 1.
min_coverage: The minimum share of directions that were seen, from 0 to 1.
max_lpips: The maximum LPIPS, where it was measured.
sort: Column whose highest values come first: score, coverage, psnr_db, length_m, num_views,
  num_points or created_at.
limit: The maximum number of rows.
gallery.limit: The maximum number of assets, of which the best are taken.
name: The asset: its id, or the beginning of it.
sql: One SELECT over the tables of the catalog, in DuckDB's SQL.
format_: Format of the file: ply, spz, gltf (a .glb file) or usd.
out: File that the asset is written to.
gallery.out: Folder that the gallery is written to: a new one, or an older gallery.
"""


@app.command()
@described(WORDS)
def publish(runs: list[str], as_json: AsJson = False) -> None:
    """Take actors, street, sky and trajectories out of finished runs into the library.

    Example: lidarpainter assets publish latest
    """
    from catalog.store import existing_store

    store, chosen = existing_store(), [named_run(run) for run in runs]
    from flows.assets import publish_run
    from flows.cli.progress import shown_progress

    with shown_progress():
        results = [publish_run(store, run) for run in chosen]
    if as_json:
        print_json({"published": results})
        return
    columns = ("run_id", "scene", "style", "num_actor", "num_street", "num_assets", "seconds")
    print_table("published", columns, [[one[name] for name in columns] for one in results])


@app.command("import")
@described(WORDS)
def import_(
    file: Path,
    category: Annotated[str, typer.Option()],
    size: str | None = None,
    up: Axis | None = None,
    forward: Axis | None = None,
    licence: str | None = None,
    as_json: AsJson = False,
) -> None:
    """Take splats or a mesh of somebody else into the library, as an actor.

    Example: lidarpainter assets import taxi.glb --category car --licence "CC BY 4.0"
    """
    from catalog.store import open_store
    from lidarpainter_models.scenes.categories import category_of

    size_m = None if size is None else parse_size(size)
    say_status(f"importing {file.name}")
    from lidarpainter_models.assets.placing import Placement
    from tasks.assets.import_file import import_file

    placement = Placement(category=category_of(category), size_m=size_m, up=up, forward=forward)
    store = open_store()
    store.make()
    result = import_file(store, file.absolute(), placement, licence)
    print_result(f"asset {result['asset_id']}", result, as_json=as_json)


def parse_size(text: str) -> tuple[float, float, float]:
    """Three lengths in metres with commas between.

    Raises:
        ConfigError: it is something else.
    """
    try:
        length_m, width_m, height_m = (float(side) for side in text.split(","))
    except ValueError:
        raise ConfigError(f"--size {text!r}: expected three metres, as 4.5,1.8,1.5") from None
    return length_m, width_m, height_m


@app.command("list")
@described(WORDS)
def list_assets(  # noqa: PLR0913 - the options of a command
    kind: str | None = None,
    category: str | None = None,
    dataset: str | None = None,
    licence: str | None = None,
    style: str | None = None,
    scene: str | None = None,
    sides: str | None = None,
    min_sides: int | None = None,
    min_length: float | None = None,
    min_score: float | None = None,
    min_coverage: float | None = None,
    max_lpips: float | None = None,
    sort: SortName = "score",
    limit: Annotated[int, typer.Option(min=1)] = 50,
    as_json: AsJson = False,
) -> None:
    """List assets: all filters that are given must hold.

    Example: lidarpainter assets list --category sedan --style night --min-sides 3 --max-lpips 0.1
    """
    from catalog.asset_queries import AssetFilter, find_assets

    wanted = AssetFilter(
        kind=kind,
        category=category,
        dataset=dataset,
        licence=licence,
        style=style,
        scene=scene,
        sides=parse_names(sides, "--sides") or (),
        min_sides=min_sides,
        min_length_m=min_length,
        min_score=min_score,
        min_coverage=min_coverage,
        max_lpips=max_lpips,
    )
    store, sql = _library()
    found = find_assets(sql, wanted, sort=sort, most=limit)
    if as_json:
        rows = [opened_row(row) for row in found.rows]
        print_json({"store": store.name, "assets": rows, "is_cut": found.is_cut})
        return
    note = f"only the first {limit} by {sort}: --limit shows more" if found.is_cut else ""
    _show_assets(f"assets in {store.name}", found.rows, note)


@app.command()
@described(WORDS)
def show(name: str, as_json: AsJson = False) -> None:
    """Show everything about an asset: each sighting, and what it was made from.

    Example: lidarpainter assets show 3f2a
    """
    from catalog.artefacts import ArtefactRef
    from catalog.assets import find_asset, sightings_of
    from catalog.explain import Explainer
    from catalog.store import existing_store
    from tasks.stages import project_source

    store = existing_store()
    asset = find_asset(store, name)
    sightings = sightings_of(store, asset["asset_id"])
    explainer = Explainer(store, project_source().code_from)
    made = explainer.artefact(ArtefactRef.of_id(asset["artefact_id"]))
    if as_json:
        rows = [opened_row(row) for row in sightings]
        print_json({**opened_row(asset), "sightings": rows, "made_from": made.to_dict()})
        return
    print_pairs(f"asset {asset['asset_id']}", {key: row_cell(key, asset[key]) for key in asset})
    columns = ("scene_id", "run_id", "actor_id", "num_views", "median_m", "sides", "score")
    alone = [row for row in sightings if row["fused_from"] is None]
    cells = [[row_cell(column, row[column]) for column in columns] for row in alone]
    print_table("sightings", columns, cells, _told_fusion(asset, sightings), num_text_columns=3)
    sys.stdout.write("\n".join(["made from", *told_explanation("", made, set())]) + "\n")


def _told_fusion(asset: "Row", sightings: "list[Row]") -> str:
    """What was fused from the sightings of an asset, and whether that serves."""
    if asset["fused_from"]:
        return f"fused from {len(asset['fused_from'])} sightings"
    scores = [row["score"] for row in sightings if row["fused_from"]]
    return f"the one fused from them is no better (score {scores[0]:.2f})" if scores else ""


@app.command()
@described(WORDS)
def query(sql: str, as_json: AsJson = False) -> None:
    """Ask all tables of the catalog by SQL, which can read them and nothing else.

    Example: lidarpainter assets query "SELECT category, count(*) FROM assets GROUP BY category"
    """
    _, library = _library()
    found = library.ask(sql, most_rows=MOST_SHOWN)
    rows = [{name: _told(value) for name, value in row.items()} for row in found.rows]
    if as_json:
        print_json({"columns": list(found.columns), "rows": rows, "is_cut": found.is_cut})
        return
    cells = [[row_cell("", row[name]) for name in found.columns] for row in rows]
    note = f"only the first {MOST_SHOWN} rows" if found.is_cut else ""
    print_table("query", found.columns, cells, note, num_text_columns=len(found.columns))


@app.command("export")
@described(WORDS)
def export(
    name: str,
    format_: Annotated[str, typer.Option("--format")],
    out: Annotated[Path, typer.Option()],
    as_json: AsJson = False,
) -> None:
    """Write an actor or a block of street for other programs, in its own frame.

    Example: lidarpainter assets export 3f2a --format gltf --out car.glb
    """
    from catalog.assets import find_asset
    from catalog.store import existing_store

    store = existing_store()
    asset = find_asset(store, name)
    say_status(f"exporting asset {asset['asset_id']}")
    from tasks.exports.asset import export_asset

    result = export_asset(store, asset, format_, out.absolute())
    print_result(f"asset {asset['name']}", result, as_json=as_json)


@app.command()
@described(WORDS)
def gallery(
    out: Annotated[Path, typer.Option()],
    category: str | None = None,
    min_score: float | None = None,
    limit: Annotated[int, typer.Option(min=1)] = 10_000,
    as_json: AsJson = False,
) -> None:
    """Write a page to leaf through the assets, which opens from the disk.

    Example: lidarpainter assets gallery --out gallery
    """
    from catalog.asset_queries import AssetFilter, find_assets

    store, sql = _library()
    wanted = AssetFilter(category=category, min_score=min_score)
    found = find_assets(sql, wanted, sort="score", most=limit)
    say_status(f"writing {len(found.rows)} assets")
    from tasks.exports.asset import export_gallery

    result = {**export_gallery(store, found.rows, out.absolute()), "is_cut": found.is_cut}
    print_result("gallery", result, as_json=as_json)


def _library() -> "tuple[Store, CatalogSql]":
    from catalog.sql import CatalogSql
    from catalog.store import existing_store

    store = existing_store()
    return store, CatalogSql(store.tables)


def _show_assets(title: str, rows: "list[Row]", note: str) -> None:
    columns = ("name", "style", "scene_ids", "sides", "coverage", "seen_share", "psnr_db", "score")
    cells = [
        [
            row["asset_id"][:ID_LENGTH],
            *(row_cell(name, row[name]) for name in columns),
            _extent(row),
        ]
        for row in rows
    ]
    print_table(title, ["asset", *columns, "size in m"], cells, note, num_text_columns=5)


def _extent(row: dict[str, Any]) -> str | None:
    """Length, width and height, those that there are."""
    sides = [row[name] for name in ("length_m", "width_m", "height_m") if row[name] is not None]
    return " x ".join(f"{side:.1f}" for side in sides) or None


def _told(value: Any) -> Any:  # noqa: ANN401 - any value that SQL can make
    """A value as JSON has it; what JSON lacks, as text."""
    if isinstance(value, list):
        return [_told(one) for one in value]
    is_plain = value is None or isinstance(value, bool | int | float | str)
    return value if is_plain else str(value)
