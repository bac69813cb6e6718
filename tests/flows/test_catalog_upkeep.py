"""Keeping a store by commands: what they find in the store of a whole run, and how they end."""

import json

import pytest
from commands import call, complaint, refuse, succeed
from tiny_street import SCENE

from catalog.store import open_store


@pytest.mark.parametrize("table", ["scenes", "runs", "artefacts", "metrics", "painters"])
def test_catalog_lists_every_table(tiny_run, table):
    found = succeed("catalog", "list", table, "--json", store=tiny_run.store).json
    assert found["table"] == table
    known = [row for row in tiny_run.rows[table] if row.get("value", 0) is not None]
    assert len(found["rows"]) >= len(known) > 0 or table == "painters"
    assert bool(found.get("absent")) == (len(known) < len(tiny_run.rows[table]))
    reasons = [one["reason"] for one in found.get("absent", [])]
    assert len(set(reasons)) == len(reasons)
    assert f"{table} in " in succeed("catalog", "list", table, store=tiny_run.store).out


def test_catalog_shows_a_scene_a_run_and_an_artefact_by_prefix(tiny_run):
    artefact = tiny_run.rows["artefacts"][0]["artefact_id"]
    names = {"scenes": SCENE, "runs": tiny_run.run_id[:10], "artefacts": artefact}
    for table, name in names.items():
        found = succeed("catalog", "show", name, "--json", store=tiny_run.store).json
        assert found["table"] == table
        assert name in succeed("catalog", "show", name, store=tiny_run.store).out


@pytest.mark.parametrize("name", ["latest", SCENE])
def test_what_stands_for_a_run_is_told_at_once(tiny_run, name):
    answer = succeed("catalog", "explain", name, store=tiny_run.store)
    assert answer.err == f"{name} is run {tiny_run.run_id} of {SCENE}\n"
    assert answer.out.startswith(f"{tiny_run.run_id} is up to date: ")


@pytest.mark.parametrize("command", ["list", "show", "explain", "delete"])
def test_every_command_of_the_catalog_answers_about_the_run(tiny_run, command):
    names = {"list": ("runs",), "delete": (tiny_run.run_id, "--dry-run")}
    words = ("catalog", command, *names.get(command, (tiny_run.run_id,)))
    assert tiny_run.run_id in succeed(*words, store=tiny_run.store).out
    assert tiny_run.run_id in json.dumps(succeed(*words, "--json", store=tiny_run.store).json)


@pytest.mark.parametrize("command", ["gc", "vacuum"])
@pytest.mark.parametrize("days", ["nan", "inf", "1000000", "-1"])
def test_days_that_are_no_time_are_refused_in_one_line(command, days, tmp_path):
    assert "--days" in complaint("catalog", command, "--days", days, store=open_store(tmp_path))


def test_a_whole_store_is_verified_and_a_flipped_bit_ends_with_1(tiny_run, own_run):
    found = succeed("catalog", "verify", "--json", store=tiny_run.store).json
    assert found["damaged"] == []
    assert found["num_checked"] > len(tiny_run.rows["artefacts"])
    assert "are as they were written" in succeed("catalog", "verify", store=tiny_run.store).out
    broken = [
        next(own_run.store.root.glob("artefacts/gaussians/*/scene.safetensors")),
        next(own_run.store.root.glob("scenes/*/*/scene.zarr/image_bytes/c/0")),
    ]
    for path in broken:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    answer = call("catalog", "verify", "--json", store=own_run.store)
    assert answer.code == 1
    names = {one["name"] for one in answer.json["damaged"]}
    assert names == {f"gaussians/{broken[0].parent.name}", f"scene {SCENE}"}
    assert "is not what was written" in call("catalog", "verify", store=own_run.store).out


def test_an_exported_run_is_imported_elsewhere_and_known_there(tiny_run, tmp_path):
    out = tmp_path / "run.tar"
    words = ("catalog", "export", tiny_run.run_id, "--out", out, "--json")
    assert succeed(*words, store=tiny_run.store).json["rows"]["runs"] == 1
    other = open_store(tmp_path / "other")
    counts = succeed("catalog", "import", out, "--json", store=other).json["new_rows"]
    assert counts["artefacts"] == len(tiny_run.rows["artefacts"])
    for table in ("scenes", "runs", "artefacts"):
        assert other.tables.rows(table) == tiny_run.rows[table]
    metrics = other.tables.rows("metrics")
    assert all(row in metrics for row in tiny_run.rows["metrics"])
    assert succeed("catalog", "verify", "--json", store=other).json["damaged"] == []
    assert succeed("catalog", "import", out, store=other).code == 0
    assert "nothing is called 'ffff'" in refuse(
        "catalog", "export", "ffff", "--out", out, store=other
    )


def test_gc_leaves_a_young_store_alone_and_says_what_would_go(tiny_run):
    found = succeed("catalog", "gc", "--json", store=tiny_run.store).json
    assert (found["is_deleted"], found["rows"]) == (False, [])
    all_of_it = succeed("catalog", "gc", "--days", "0", "--json", store=tiny_run.store).json
    assert {one["id"] for one in all_of_it["rows"]} >= {tiny_run.run_id, SCENE}
    told = succeed("catalog", "gc", "--days", "0", store=tiny_run.store).out
    assert "nothing was deleted: --delete does" in told
    assert tiny_run.store.tables.find("runs", tiny_run.run_id) == tiny_run.rows["runs"][0]


def test_tables_are_compacted_vacuumed_and_read_as_they_were(own_run):
    tables = succeed("catalog", "compact", "--json", store=own_run.store).json["tables"]
    assert {one["table"] for one in tables} >= {"runs", "artefacts"}
    assert all(one["files_after"] == 1 for one in tables)
    kept = succeed("catalog", "vacuum", "--json", store=own_run.store).json
    assert (kept["is_deleted"], sum(kept["num_files"].values())) == (False, 0)
    now = succeed("catalog", "list", "runs", "--json", store=own_run.store).json["rows"]
    first = succeed("catalog", "list", "runs", "--as-of", "1", "--json", store=own_run.store)
    assert first.json["rows"][0]["status"] == "running"
    assert {row["status"] for row in now if row["preset"]} == {"complete"}
    later = ("catalog", "list", "runs", "--as-of", "2100-01-01", "--json")
    assert succeed(*later, store=own_run.store).json["rows"] == now


def test_nothing_is_stale_and_the_scene_has_a_cost(tiny_run):
    stale = succeed("catalog", "stale", "--json", store=tiny_run.store).json
    assert (stale["scenes"], stale["runs"]) == (0, [])
    cost = succeed("catalog", "cost", SCENE, "--json", store=tiny_run.store).json
    spent = {kind: one["cpu_seconds"] for kind, one in cost["stages"].items()}
    assert set(spent) >= {"observations", "gaussians", "guidance", "evaluation", "report"}
    made = [row for row in tiny_run.rows["artefacts"] if row["kind"] == "observations"]
    summaries = [json.loads(row["summary"]) for row in made]
    assert spent["observations"] >= sum(one["cpu_seconds"] for one in summaries) > 0
    assert cost["attempts"]["money"] is None
    assert "stage: gaussians" in succeed("catalog", "cost", SCENE, store=tiny_run.store).out
