"""Tables of pages are what the record says, and the record is what the manifest asks for."""

import re
from pathlib import Path

import pytest

from flows.measure.configurations import chart_ways
from flows.measure.figure_manifest import cells_of, read_figure_manifest
from flows.measure.figures import figure_of, written
from flows.measure.tables import (
    MissingFigureError,
    marked_tables,
    read_pages,
    read_record,
    rendered,
    with_tables,
)
from flows.presets import preview
from lidarpainter_models.errors import ConfigError

ROOT = Path(__file__).resolve().parents[3]
OURS = ROOT / "docs" / "figures.toml"
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
SMALL = """
pages = ["page.md"]
record = "figures.json"

[[fleet]]
name = "two"
fit_seeds = [0, 1]
source = [{ dataset = "synthetic", seeds = "4:6" }]
configuration = [{ name = "plain" }, { name = "long" }]

[[table]]
name = "small"
fleet = "two"
corner = "which"
row = [
  { label = "street 4", scene = "synthetic/street-0004" },
  { label = "both", columns = ["plain"], variant = "unpainted" },
]
column = [
  { label = "plain", configuration = "plain", figures = ["recorded_psnr", "truth/left-2m/ssim"] },
  { label = "long", configuration = "long", figures = ["cpu_minutes"] },
]
"""
"""Two streets in two ways with two seeds."""


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def record_of(manifest, table, value):
    """A record of a table in which the figures of a point are `value(point, key)`."""
    asked = {}
    for cell in cells_of(manifest, table).values():
        for name in cell.points:
            asked.setdefault(name, []).extend(cell.keys)
    told = {"run": "r", "version": "1", "code": "c", "date": "d", "cpu": "cpu", "threads": 1}
    return {
        name: {**told, "figures": {key: value(name, key) for key in keys}}
        for name, keys in asked.items()
    }


# --- this repository


def test_every_table_of_our_pages_is_what_the_record_says():
    manifest = read_figure_manifest(OURS)
    record = read_record(OURS.parent / manifest.record)
    shown = {
        name: body
        for page, text in read_pages(manifest, OURS.parent).items()
        for name, body in marked_tables(text, page.name).items()
    }
    for table in manifest.table:
        told = "is not what docs/records/figures.json says: make figures writes it"
        expected = rendered(manifest, table, record[table.name])
        assert shown[table.name] == expected, f"table {table.name} {told}"


def test_the_record_holds_what_our_tables_ask_for_and_nothing_else():
    manifest = read_figure_manifest(OURS)
    record = read_record(OURS.parent / manifest.record)
    assert set(record) == {table.name for table in manifest.table}
    for table in manifest.table:
        asked = record_of(manifest, table, lambda _name, _key: 0.0)
        held = record[table.name]
        assert {name: set(entry["figures"]) for name, entry in held.items()} == {
            name: set(entry["figures"]) for name, entry in asked.items()
        }, table.name
        for entry in held.values():
            assert re.fullmatch("[0-9a-f]{16}", entry["run"])
            assert all(entry[name] for name in ("version", "code", "date", "cpu", "threads"))


def test_no_page_of_ours_has_a_table_that_the_manifest_does_not_know():
    manifest = read_figure_manifest(OURS)
    known = {(OURS.parent / page).resolve() for page in manifest.pages}
    marked = {page for page in PAGES if marked_tables(page.read_text("utf-8"), page.name)}
    assert marked == known


def test_the_chart_of_our_manifest_is_that_of_the_command():
    chart = next(fleet for fleet in read_figure_manifest(OURS).fleet if fleet.name == "chart")
    assert chart.configuration == chart_ways(preview("pandaset/002"))


# --- how a table reads


def test_a_cell_is_the_mean_over_scenes_and_seeds_in_the_unit_of_its_figure(small):
    manifest = read_figure_manifest(small)
    (table,) = manifest.table

    def value(name, key):
        number = 10.0 * ("street-0005" in name) + ("seed 1" in name)
        return {
            "final recorded_psnr": 30.0 + number,
            "final truth/left-2m/ssim": 0.9,
            "unpainted recorded_psnr": 20.0 + number,
            "unpainted truth/left-2m/ssim": 1.0,
            "cpu_seconds": 90.0 + 6 * number,
        }[key]

    assert rendered(manifest, table, record_of(manifest, table, value)).splitlines() == [
        "| which | plain | long |",
        "|---|---|---|",
        "| street 4 | 30.50 / .900 | 1.6 |",  # 90 and 96 s
        "| both | 25.50 / 1.000 |  |",
        "",
        "*d, lidarpainter 1, code c, 1 thread of cpu.*",
    ]


def test_a_table_is_never_half_filled(small):
    manifest = read_figure_manifest(small)
    (table,) = manifest.table
    record = record_of(manifest, table, lambda _name, _key: 1.0)
    del record["two long synthetic/street-0004 seed 1"]["figures"]["cpu_seconds"]
    with pytest.raises(MissingFigureError, match="no figure 'cpu_seconds' of two long"):
        rendered(manifest, table, record)


@pytest.mark.parametrize(
    ("figure", "value", "text"),
    [
        ("recorded_psnr", 30.004, "30.00"),
        ("recorded/recorded/actors_psnr", 28.655, "28.66"),
        ("depth/up-1.5m/depth_within_5_percent", 0.9414, ".941"),
        ("recorded/recorded/feature_distance", 2.5, "2.50"),
        ("num_gaussians", 79_871, "79,871"),
        ("cpu_minutes", 93, "1.6"),
        ("memory_gb", 1.44e9, "1.4"),
    ],
)
def test_a_figure_is_written_in_its_unit(figure, value, text):
    assert written(figure, value) == text


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('fleet = "two"', 'fleet = "three"', "no fleet 'three', there is two"),
        ('configuration = "long"', 'configuration = "short"', "no configuration 'short'"),
        ("street-0004", "street-0007", "has no scene synthetic/street-0007"),
        ('["plain"]', '["plane"]', "row 'both': no column plane"),
        ("cpu_minutes", "cpu_hours", "no figure 'cpu_hours'"),
        ("recorded_psnr", "recorded/recorded/colour", "is written is not known"),
        ('"unpainted"', '"half-painted"', "table.0.row.1.variant"),
        ('["plain"]', '["long"]', "cpu_minutes is of a whole run"),
        ('dataset = "synthetic", seeds = "4:6"', 'dataset = "pandaset", root = "x"', "a source of"),
        ('corner = "which"', 'corner = "a|b"', "table.0.corner"),
        ('name = "small"', 'nam = "small"', "table.0"),
    ],
)
def test_a_fault_of_a_manifest_is_one_line(small, old, new, told):
    small.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(ConfigError, match=re.escape(told)) as caught:
        read_figure_manifest(small)
    assert "small.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


# --- pages


def test_only_what_stands_between_the_comments_is_written():
    text = "a\n<!-- figures: one -->\nold\n<!-- /figures -->\nb <!-- other -->\n"
    written_once = with_tables(text, {"one": "| new |"})
    assert written_once.startswith("a\n<!-- figures: one -->\n")
    assert written_once.endswith("<!-- /figures -->\nb <!-- other -->\n")
    assert marked_tables(written_once, "page") == {"one": "| new |"}
    assert with_tables(written_once, {"one": "| new |"}) == written_once
    assert with_tables(text, {"two": "| new |"}) == text


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("nothing", "without a place.*: small"),
        ("<!-- figures: small -->\n<!-- /figures -->\n" * 2, "page.md: expected for"),
        ("<!-- figures: small -->\n", "page.md: expected for"),
        ("<!-- figures: other -->\n<!-- /figures -->", "other, small"),
    ],
)
def test_a_table_stands_in_one_place(small, text, told):
    (small.parent / "page.md").write_text(text)
    with pytest.raises(ConfigError, match=told):
        read_pages(read_figure_manifest(small), small.parent)


def test_comments_inside_a_line_are_no_places():
    assert marked_tables("`<!-- figures: NAME -->` ... `<!-- /figures -->`\n", "page") == {}


def test_a_record_that_is_none_is_refused(tmp_path):
    path = tmp_path / "figures.json"
    assert read_record(path) == {}
    for text in ("[", "[1]", '{"a": 1}'):
        path.write_text(text)
        with pytest.raises(ConfigError, match="expected a record of figures"):
            read_record(path)


def test_the_end_of_a_point_and_its_variants_are_told_apart():
    from catalog.points import Point

    name = ("recorded", "recorded", "psnr")
    point = Point(
        scene="a/b",
        configuration="c",
        seed=0,
        run_id="r",
        cost=dict.fromkeys(("cpu_seconds", "seconds"), 3.0),
        metrics={name: 2.0},
        by_variant={"unpainted": {name: 1.0}, "painted": {name: 2.0}},
    )
    assert figure_of(point, "recorded_psnr", "final") == 2.0
    assert figure_of(point, "recorded_psnr", "unpainted") == 1.0
    assert figure_of(point, "recorded_psnr", "view-time") is None
    assert figure_of(point, "recorded/recorded+aside/psnr", "final") is None
    assert figure_of(point, "cpu_seconds", "final") == 3.0
