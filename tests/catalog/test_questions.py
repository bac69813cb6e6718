"""What is stale and what things cost, from a store whose answers are known by hand."""

import json
from datetime import datetime, timedelta

import pytest

from catalog.artefacts import Recipe
from catalog.code_closure import Code
from catalog.errors import IdentityError, UnknownRecordError
from catalog.questions import NEW_CONTENT, UNKNOWN_CODE, cost_of, stale_runs
from catalog.records import artefact_row
from catalog.store import open_store

START = {"prepare": "tasks.prepare:build", "fit": "tasks.fit:build", "judge": "tasks.judge:build"}
CODE = {"tasks.prepare": "p1", "tasks.fit": "f1", "tasks.judge": "j1", "library.loss": "l1"}
USES = {
    "prepare": ["tasks.prepare"],
    "fit": ["tasks.fit", "library.loss"],
    "judge": ["tasks.judge"],
}
SECONDS = {"prepare": 1.0, "fit": 10.0, "judge": 4.0}


def code_of(stage, digests):
    return Code((START[stage],), {name: digests[name] for name in USES[stage]})


def today(digests):
    stages = {start: stage for stage, start in START.items()}
    return lambda starts: code_of(stages[next(iter(starts))], digests)


class Books:
    """Two scenes; each was prepared, fitted and judged, the first one by two runs."""

    def __init__(self, root):
        self.store = open_store(root)
        self.rows = {"runs": [], "artefacts": {}}
        scenes = [{"scene_id": f"toy/{name}", "content_digest": f"{name}-1"} for name in "ab"]
        self.store.tables.merge("scenes", scenes)
        self.run("old", "toy/a", steps=1, hour=1)
        self.run("new", "toy/a", steps=1, hour=2)
        self.run("more", "toy/a", steps=2, hour=1)
        self.run("other", "toy/b", steps=1, hour=1)
        self.store.tables.merge("runs", self.rows["runs"])
        self.store.tables.merge("artefacts", list(self.rows["artefacts"].values()))

    def run(self, run_id, scene_id, *, steps, hour):
        prepared = self.made("prepare", steps=0, scene=f"{scene_id[-1]}-1")
        fitted = self.made("fit", steps=steps, observations=prepared.digest)
        judged = self.made("judge", steps=0, gaussians=fitted.digest)
        row = {
            "run_id": run_id,
            "scene_id": scene_id,
            "parameters": json.dumps({"steps": steps}),
            "status": "complete",
            "finished_at": f"2026-11-22T0{hour}:00:00+00:00",
            "artefacts": [ref.artefact_id for ref in (prepared, fitted, judged)],
        }
        self.rows["runs"].append({**row, "finished_at": datetime.fromisoformat(row["finished_at"])})

    def made(self, stage, *, steps, **inputs):
        recipe = Recipe(kind=stage, inputs=inputs, config=steps, code=code_of(stage, CODE))
        summary = {"cpu_seconds": 2 * SECONDS[stage]}
        ref, _ = self.store.artefacts.produce(recipe, lambda _place: summary)
        row = artefact_row(ref, self.store.artefacts.manifest(ref))
        self.rows["artefacts"][ref.artefact_id] = {**row, "seconds": SECONDS[stage]}
        return ref

    def stale(self, **changed):
        found = stale_runs(self.store, today({**CODE, **changed}))
        kinds = {one.run_id: {name.partition("/")[0] for name in one.artefacts} for one in found}
        return found, kinds


@pytest.fixture(scope="module")
def books(tmp_path_factory):
    return Books(tmp_path_factory.mktemp("books") / "store")


def test_nothing_is_stale_under_the_same_code(books):
    assert books.stale() == ([], {})


def test_a_loss_redoes_fits_and_what_follows(books):
    found, kinds = books.stale(**{"library.loss": "l2"})
    assert kinds == {run: {"fit", "judge"} for run in ("new", "more", "other")}
    assert {one.changed for one in found} == {("library.loss",)}
    assert {(one.total("seconds"), one.total("cpu_seconds")) for one in found} == {(14.0, 28.0)}
    assert [one.scene_id for one in found] == ["toy/a", "toy/a", "toy/b"]


def test_a_run_and_what_it_was_changed_into_are_both_told(tmp_path):
    books = Books(tmp_path / "store")
    new = books.store.tables.row("runs", "new")
    edited = {**new, "run_id": "edited", "derived_from": "new", "change": '{"kind":"edit"}'}
    later = new["finished_at"] + timedelta(hours=1)
    books.store.tables.merge("runs", [{**edited, "finished_at": later}])
    kinds = books.stale(**{"library.loss": "l2"})[1]
    assert set(kinds) == {"new", "edited", "more", "other"}


def test_one_change_of_two_runs_makes_two_others(tmp_path):
    books = Books(tmp_path / "store")
    new = books.store.tables.row("runs", "new")
    ways = {
        "day": ("new", "edit"),
        "foggy": ("new", "style"),
        "foggy-edited": ("foggy", "edit"),
        "of-one-gone": ("gone", "edit"),
        "day-again": ("old", "edit"),  # of a run that `new` stands for
    }
    rows = [
        {
            **new,
            "run_id": run_id,
            "derived_from": source,
            "change": f'{{"kind":"{kind}"}}',
            "finished_at": new["finished_at"] + timedelta(hours=hours),
        }
        for hours, (run_id, (source, kind)) in enumerate(ways.items())
    ]
    books.store.tables.merge("runs", rows)
    kinds = books.stale(**{"library.loss": "l2"})[1]
    assert set(kinds) == {"new", "more", "other", *ways} - {"day"}


def test_what_is_prepared_redoes_all_and_a_judge_only_itself(books):
    assert set(map(frozenset, books.stale(**{"tasks.prepare": "p2"})[1].values())) == {
        frozenset({"prepare", "fit", "judge"})
    }
    assert set(map(frozenset, books.stale(**{"tasks.judge": "j2"})[1].values())) == {
        frozenset({"judge"})
    }


def test_a_row_of_older_software_is_judged_by_its_manifest(books, monkeypatch):
    rows = [{**row, "starts": None} for row in books.rows["artefacts"].values()]
    monkeypatch.setattr(books.store.tables, "arrow", with_rows(books.store.tables.arrow, rows))
    assert books.stale()[0] == []
    assert books.stale(**{"library.loss": "l2"})[1]["new"] == {"fit", "judge"}


def with_rows(arrow, rows):
    import pyarrow as pa

    def found(table, **options):
        real = arrow(table, **options)
        if table != "artefacts":
            return real
        named = [{name: row[name] for name in real.column_names} for row in rows]
        return pa.Table.from_pylist(named, schema=real.schema)

    return found


def test_code_that_is_gone_and_scenes_read_anew_are_told(books, monkeypatch):
    def gone(_starts):
        raise IdentityError("there is no source of tasks.fit")

    found = stale_runs(books.store, gone)
    assert {one.changed for one in found} == {(UNKNOWN_CODE,)}
    monkeypatch.setattr(
        books.store.tables,
        "arrow",
        lambda table, _arrow=books.store.tables.arrow, **options: (
            _arrow(table, **options).slice(0, 1) if table == "scenes" else _arrow(table, **options)
        ),
    )
    found, kinds = books.stale()
    assert len(kinds) in (1, 2)  # one of the two scenes has other content now
    assert {one.changed for one in found} == {(NEW_CONTENT,)}


def test_what_a_scene_has_cost(books):
    attempt = {"fleet": "night", "scene_id": "toy/b", "num_bytes": 5, "cpu_seconds": 100.0}
    attempts = [
        {**attempt, "attempt_id": "1", "cause": "killed", "seconds": 1800.0},
        {**attempt, "attempt_id": "2", "cause": "done", "seconds": 3600.0, "num_bytes": None},
        {**attempt, "attempt_id": "3", "cause": "done", "seconds": 60.0, "fleet": "unpriced"},
        {**attempt, "attempt_id": "4", "scene_id": "toy/c", "cause": "done", "seconds": 9.0},
        {**attempt, "attempt_id": "5", "scene_id": "toy/d", "cause": None, "seconds": 7.0},
        {**attempt, "attempt_id": "6", "scene_id": "toy/d", "cause": "done", "seconds": 9.0},
    ]
    attempts[1]["peak_memory_bytes"] = 10**9
    fleets = {"night": '{"money_per_hour": 0.5}', "unpriced": "{}"}
    asked = [{"sequence_id": name, "fleet": name, "budget": one} for name, one in fleets.items()]
    books.store.tables.merge("attempts", attempts)
    books.store.tables.merge("sequences", asked)
    found = cost_of(books.store, "toy/b")
    assert found["attempts"] == {
        "attempts": 3,
        "seconds": 5460.0,
        "cpu_seconds": 300.0,
        "num_bytes": 10,
        "peak_memory_bytes": 10**9,
        "money": 0.75,
    }
    assert found["by_cause"]["killed"]["money"] == 0.25
    assert {kind: one["seconds"] for kind, one in found["stages"].items()} == SECONDS
    assert found["stages_total"]["cpu_seconds"] == 30.0
    spent = {
        name: one["seconds"] for name, one in cost_of(books.store, "toy/d")["by_cause"].items()
    }
    assert spent == {"done": 9.0, "unknown": 7.0}
    shared = cost_of(books.store, "toy/a")
    assert shared["runs"] == 3
    assert shared["stages"]["prepare"]["seconds"] == 1.0  # three runs share it
    assert shared["attempts"]["money"] is None
    with pytest.raises(UnknownRecordError, match="no run and no attempt of a scene 'toy/x'"):
        cost_of(books.store, "toy/x")
