"""A run that was changed into a new one: it can be used like any other, and leads back."""

import json
from dataclasses import replace
from functools import partial

import pytest
import torch
from commands import call, succeed

from flows.derive import Change, derive_run
from lidarpainter_models.gaussians.model.gaussian_scene import describe
from tasks.runs import open_run
from tasks.stored import load_scene, save_scene

BRIGHTER = Change(kind="brighten", parameters={"by": 0.5})


def _build(place, _progress, *, scene, by):
    found = scene()
    columns = found.gaussians.columns() | {"sh_dc": found.gaussians.sh_dc + by}
    changed = found.with_gaussians(type(found.gaussians)(**columns))
    save_scene(place.output, changed, [])
    return describe(changed) | {"by": by}


@pytest.fixture(scope="module")
def derive(own_run):
    """Brightens the tiny run."""
    # a test's own functions are no part of the project's source, which names stages by their code
    source = own_run.store, open_run(own_run.store, own_run.run_id)

    def derived(change=BRIGHTER):
        store, run = source
        scene = partial(load_scene, store, run.final.gaussians)
        build = partial(_build, scene=scene, **change.parameters)
        return derive_run(store, run, change, build=build)

    with pytest.MonkeyPatch.context() as patched:
        from tasks import stages as sources

        known = sources.project_source()
        there = known.code_from(("tasks.stored:save_scene",))
        parts = {"code": lambda _self, _build: there, "code_from": lambda _self, _starts: there}
        stand_in = type("Source", (), parts)()
        for module in ("flows.derive", "tasks.stages"):
            patched.setattr(f"{module}.project_source", lambda: stand_in)
        yield derived


def test_a_changed_run_leads_back_and_leaves_its_source_alone(own_run, derive):
    before = load_scene(own_run.store, open_run(own_run.store, own_run.run_id).final.gaussians)
    result = derive()
    run = open_run(own_run.store, result["run_id"])
    assert run.derived_from == own_run.run_id == result["derived_from"]
    assert run.change == {"kind": "brighten", "parameters": {"by": 0.5}}
    after = load_scene(own_run.store, run.final.gaussians)
    assert torch.equal(after.gaussians.sh_dc, before.gaussians.sh_dc + 0.5)
    shown = succeed("catalog", "show", result["run_id"], "--json", store=own_run.store).json
    assert shown["derived_from"] == own_run.run_id
    words = ("catalog", "explain", result["run_id"])
    assert succeed(*words, store=own_run.store).out.startswith(f"{result['run_id']} is ")
    explained = succeed(*words, "--verbose", store=own_run.store).out
    assert f"derived_from: {own_run.run_id}" in explained


def test_the_same_change_is_recalled_and_another_one_is_not(derive):
    first, again = derive(), derive()
    other = derive(replace(BRIGHTER, parameters={"by": 0.25}))
    assert again["run_id"] == first["run_id"] != other["run_id"]
    assert again["computed_now"] == {"brighten": False}


@pytest.mark.slow
def test_a_changed_run_is_shown_judged_and_deleted_without_its_source(own_run, derive, tmp_path):
    store = own_run.store
    run_id = derive(replace(BRIGHTER, parameters={"by": -0.3}))["run_id"]
    path = ("--trajectory", "recorded", "--frames", "0:1")
    for run, out in ((own_run.run_id, "source"), (run_id, "derived")):
        succeed("render", run, *path, "--out", tmp_path / out, store=store)
    images = [(tmp_path / name / "0000.png").read_bytes() for name in ("source", "derived")]
    assert images[0] != images[1]
    succeed("stylize", run_id, "--prompt", "foggy", "--out", tmp_path / "s", *path, store=store)
    judged = succeed("evaluate", run_id, "--json", store=store).json
    assert judged["painted"]["recorded"]["psnr"] < own_run.result["recorded"]["psnr"]
    assert "unpainted" not in judged
    plan = succeed("catalog", "delete", run_id, "--dry-run", "--json", store=store).json
    going = [row["id"] for row in plan["rows"] if row["table"] == "artefacts"]
    final = open_run(store, run_id).final
    assert final.gaussians.artefact_id in going
    assert final.observations.artefact_id not in going
    of_source = call("catalog", "delete", own_run.run_id, "--dry-run", "--json", store=store)
    kept = {final.gaussians.artefact_id, final.observations.artefact_id}
    assert not kept & {row["id"] for row in json.loads(of_source.out)["rows"]}
