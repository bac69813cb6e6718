"""The library gives the assets that are asked for, and only those."""

import pytest

from catalog.asset_queries import AssetFilter, find_assets
from catalog.errors import UnknownRecordError
from catalog.sql import CatalogSql
from catalog.tables import CatalogTables

SEDAN = {"category": "Car", "length_m": 4.6, "height_m": 1.5}
ROWS = [
    {"asset_id": "a1", **SEDAN, "style": "night:1", "sides": ["front", "left", "top"]}
    | {"score": 0.4, "lpips": 0.05, "scene_ids": ["pandaset/002", "pandaset/003"]},
    {"asset_id": "a2", **SEDAN, "style": "night:1", "sides": ["front", "left", "rear"]}
    | {"score": 0.9, "category": "vehicle.car"},
    {"asset_id": "b1", **SEDAN, "style": "night:1", "sides": ["front", "left", "rear"]}
    | {"score": 0.8, "lpips": 0.2},
    {"asset_id": "b2", **SEDAN, "style": "night:1", "sides": ["front"], "score": 0.95},
    {"asset_id": "b3", **SEDAN, "sides": ["front", "left", "rear"], "licence": "CC BY 4.0"},
    {"asset_id": "b4", **SEDAN, "style": "night:1", "height_m": 1.9, "sides": ["front"] * 3},
    {"asset_id": "c1", "kind": "street", "category": "street", "coverage": 0.5},
]


@pytest.fixture(scope="module")
def sql(tmp_path_factory):
    tables = CatalogTables(str(tmp_path_factory.mktemp("tables")))
    tables.merge("assets", ROWS)
    sightings = [("s1", "a1", 0.1), ("s2", "a1", 0.4), ("s3", "a2", 0.9)]
    tables.merge(
        "sightings",
        [{"sighting_id": one, "asset_id": of, "score": score} for one, of, score in sightings],
    )
    return CatalogSql(tables)


def found(sql, sort="score", most=10, **wanted):
    return [
        row["asset_id"]
        for row in find_assets(sql, AssetFilter(**wanted), sort=sort, most=most).rows
    ]


def test_night_sedans_seen_from_three_sides_are_one_question(sql):
    wanted = {"category": "sedan", "style": "night", "min_sides": 3, "max_lpips": 0.1}
    assert found(sql, **wanted) == ["a2", "a1"]  # b1 is unlike, b2 one-sided, b4 tall


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ({"category": "car"}, {"a1", "a2", "b1", "b2", "b3", "b4"}),
        ({"category": "vehicle.car"}, {"a2"}),
        ({"kind": "street"}, {"c1"}),
        ({"style": "recorded"}, {"b3", "c1"}),
        ({"sides": ("left", "rear")}, {"a2", "b1", "b3"}),
        ({"scene": "pandaset/003"}, {"a1"}),
        ({"licence": "by"}, {"b3"}),
        ({"min_score": 0.9}, {"a2", "b2"}),
        ({"min_coverage": 0.5}, {"c1"}),
        ({"min_length_m": 4.7}, set()),
        ({"dataset": "' OR true --"}, set()),
    ],
)
def test_each_filter_keeps_what_it_says(sql, wanted, expected):
    assert set(found(sql, **wanted)) == expected


def test_the_highest_come_first_those_without_a_value_last(sql):
    assert found(sql)[:3] == ["b2", "a2", "b1"]
    assert found(sql, sort="coverage")[0] == "c1"
    assert found(sql, most=2) == ["b2", "a2"]


def test_an_unknown_word_says_what_there_is(sql):
    with pytest.raises(UnknownRecordError, match=r"Car, street, vehicle\.car"):
        found(sql, category="tram")
    with pytest.raises(UnknownRecordError, match="front, rear"):
        found(sql, sides=("below",))
