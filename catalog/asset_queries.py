"""Questions about the asset library: which assets there are, and everything about one.

They are SQL with values beside it, see `catalog.sql`; what an asset was made from is told by
`catalog.explain`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from catalog.errors import UnknownRecordError
from catalog.sql import Answer, CatalogSql

Sort = Literal["score", "coverage", "psnr_db", "length_m", "num_views", "num_points", "created_at"]
SIDES = ("front", "rear", "left", "right", "top")
AS_RECORDED = "recorded"
"""The style of what wears none."""
SEDAN = "sedan"
_SEDAN = "length_m BETWEEN 4.1 AND 5.3 AND height_m <= 1.6"
"""No data set says sedan, all say car: these are the lengths and heights of sedans."""


@dataclass(frozen=True, kw_only=True)
class AssetFilter:
    """Which assets are wanted; every field that is given must hold."""

    kind: str | None = None
    category: str | None = None
    """Such as `car`, which also finds `vehicle.car` and `Car` of earlier software, or `sedan`."""
    dataset: str | None = None
    licence: str | None = None
    """A part of it: `BY` finds `CC BY 4.0`."""
    style: str | None = None
    """A word of the style, as `night`, or `recorded`."""
    scene: str | None = None
    """dataset/sequence of a sighting."""
    sides: tuple[str, ...] = ()
    """All of these were seen."""
    min_sides: int | None = None
    min_length_m: float | None = None
    min_score: float | None = None
    min_coverage: float | None = None
    max_lpips: float | None = None
    """Where it was measured; without the weights for it nothing would pass."""

    def __post_init__(self) -> None:
        """Refuse sides that nothing has.

        Raises:
            UnknownRecordError: there is no such side.
        """
        if unknown := set(self.sides) - set(SIDES):
            raise UnknownRecordError(
                f"no side {min(unknown)!r}, expected some of {', '.join(SIDES)}"
            )


_CONDITIONS = {
    "kind": "kind = $kind",
    "dataset": "dataset = $dataset",
    "licence": "contains(lower(licence), lower($licence))",
    "style": "contains(style, $style)",
    "scene": "list_contains(scene_ids, $scene)",
    "sides": "list_has_all(sides, $sides)",
    "min_sides": "len(sides) >= $min_sides",
    "min_length_m": "length_m >= $min_length_m",
    "min_score": "score >= $min_score",
    "min_coverage": "coverage >= $min_coverage",
    "max_lpips": "(lpips IS NULL OR lpips < $max_lpips)",
}


def find_assets(sql: CatalogSql, wanted: AssetFilter, *, sort: Sort, most: int) -> Answer:
    """The assets that are wanted, the highest of a column first.

    Raises:
        UnknownRecordError: no asset is of that category.
    """
    conditions, values = ["true"], {}
    for name, condition in _CONDITIONS.items():
        value = getattr(wanted, name)
        if value is not None and value != ():
            conditions.append(condition)
            values[name] = list(value) if isinstance(value, tuple) else value
    if wanted.style == AS_RECORDED:
        del values["style"]
        conditions[conditions.index(_CONDITIONS["style"])] = "style IS NULL"
    if wanted.category is not None:
        conditions += _of_category(sql, wanted.category, values)
    return sql.ask(
        f"SELECT * FROM assets WHERE {' AND '.join(conditions)} "  # noqa: S608 - values stand beside
        f"ORDER BY {sort} DESC NULLS LAST, asset_id",
        values,
        most_rows=most,
    )


def _of_category(sql: CatalogSql, asked: str, values: dict[str, Any]) -> Iterator[str]:
    """The conditions of a category: by its words in the data sets, files can be skipped."""
    known = [row["category"] for row in sql.ask("SELECT DISTINCT category FROM assets").rows]
    word = asked.lower()
    if word == SEDAN:
        word = "car"
        yield _SEDAN
    values["categories"] = [
        name for name in known if word in (name.lower(), name.lower().rpartition(".")[2])
    ]
    if not values["categories"]:
        raise UnknownRecordError(
            f"no asset of category {asked!r}; there are {', '.join(sorted(known)) or 'none'}"
        )
    yield "list_contains($categories, category)"
