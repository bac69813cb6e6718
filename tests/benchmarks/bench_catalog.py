"""What the asset library costs as it grows: one scene merged into it, and questions asked of it.

    PYTHONPATH=.:tests/support python tests/benchmarks/bench_catalog.py [ROWS ...]

CPU seconds of one thread, each in a process of its own, with the largest resident memory of that
process. `new` enters 50 sightings of a scene that is new, and so their assets, `again` those of a
scene that is there, seen otherwise; `rewritten` is the share of both tables' bytes that `again`
wrote. `open` begins a session of SQL, `night sedans` asks for sedans seen from three sides at night
with LPIPS under 0.1, `one` for an asset by the beginning of its id, `by category` counts all of
them.
"""

import sys
import tempfile
import time
from pathlib import Path

from asset_rows import ACTORS_A_SCENE, asset_id, asset_rows, sighting_rows
from deltalake import DeltaTable, write_deltalake
from own_process import in_own_process, peak_bytes
from rich.console import Console
from rich.table import Table

from catalog.asset_queries import AssetFilter, find_assets
from catalog.assets import enter_sightings, find_asset
from catalog.sql import CatalogSql
from catalog.store import open_store
from catalog.tables import FILE_BYTES

TABLES = {"assets": asset_rows, "sightings": sighting_rows}
MEASURED = ("new", "again", "ask")
AT_ONCE = 100_000
NIGHT_SEDANS = AssetFilter(category="sedan", style="night", min_sides=3, max_lpips=0.1)


def fill(root, count):
    """A library as merges have left it: written scene after scene, its files as large as theirs."""
    tables = open_store(root).tables
    for name, drawn in TABLES.items():
        tables.merge(name, drawn(1).to_pylist())
        uri = f"{tables.root}/{name}"
        for first in range(1, count, AT_ONCE):
            rows = drawn(min(AT_ONCE, count - first), first=first)
            write_deltalake(uri, rows, mode="append", target_file_size=FILE_BYTES)
        DeltaTable(uri).optimize.compact(target_size=FILE_BYTES)


def measure(what, root, count):
    """CPU seconds by name, and the largest memory of this process."""
    found = ask(root, count) if what == "ask" else merge(what, root, count)
    return found | {"MB": peak_bytes() / 1e6}


def merge(what, root, count):
    """One scene more, or one that is there."""
    first = count if what == "new" else count // 3 // ACTORS_A_SCENE * ACTORS_A_SCENE
    rows = sighting_rows(ACTORS_A_SCENE, first=first).to_pylist()
    store = open_store(root)
    before = sizes(root)
    seconds = timed(lambda: enter_sightings(store, rows, is_same))
    after = sizes(root)
    written = sum(size for path, size in after.items() if path not in before)
    return {what: seconds, f"{what} wrote": written / sum(after.values())}


def is_same(one, other):
    return one["occurrence_id"] == other["occurrence_id"]


def ask(root, count):
    """The questions, one after the other."""
    opened = []
    found = {"open": timed(lambda: opened.append(CatalogSql(open_store(root).tables)))}
    (sql,) = opened
    questions = {
        "night sedans": lambda: find_assets(sql, NIGHT_SEDANS, sort="score", most=50),
        "one": lambda: find_asset(open_store(root), asset_id(count // 2)[:12]),
        "by category": lambda: sql.ask("SELECT category, count(*) FROM assets GROUP BY category"),
    }
    return found | {name: timed(question) for name, question in questions.items()}


def timed(action):
    start = time.process_time()
    action()
    return time.process_time() - start


def sizes(root):
    """Bytes of the tables' files, by path."""
    tables = open_store(root).tables
    return {path: Path(path).stat().st_size for name in TABLES for path in tables.files(name)}


def main(counts):
    """Print a row for each size of the library."""
    heads = ("assets", "MB", "files", "new", "again", "rewritten", "merge MB", "open")
    shown = Table(*heads, "night sedans", "one", "by category", "ask MB", title="CPU seconds")
    for count in counts:
        with tempfile.TemporaryDirectory() as root:
            fill(root, count)
            found = {what: in_own_process(measure, what, root, count) for what in MEASURED}
            stored = sizes(root)
        new, again, ask_ = (found[what] for what in MEASURED)
        shown.add_row(
            f"{count:,}",
            f"{sum(stored.values()) / 1e6:.1f}",
            str(len(stored)),
            f"{new['new']:.2f}",
            f"{again['again']:.2f}",
            f"{again['again wrote']:.0%}",
            f"{max(new['MB'], again['MB']):.0f}",
            *(f"{ask_[name]:.2f}" for name in ("open", "night sedans", "one", "by category")),
            f"{ask_['MB']:.0f}",
        )
    Console(width=140).print(shown)


if __name__ == "__main__":
    main([int(count) for count in sys.argv[1:]] or [1_000, 10_000, 100_000, 1_000_000])
