"""What the end of a run is among the variants that were judged."""

import json

import pytest
from fleet_wishes import wish

from catalog.fleets import FleetLedger
from catalog.points import points_of
from catalog.retries import Ending
from catalog.store import open_store

RESULT = {
    "seconds": {"fit": 3.0, "total": 9.0},
    "cpu_seconds": {"fit": 5.0, "evaluate": 2.0, "total": 7.0},
    "memory_bytes": {"fit": 100, "evaluate": 300},
    "peak_memory_bytes": 300,
    "num_gaussians": 10,
}


def point_of(store, *, fitted, judged):
    """The point of a run that fitted some scenes, with one PSNR for each variant."""
    made = [f"gaussians/{number}" for number in range(fitted)]
    run = {"run_id": "run", "status": "complete", "artefacts": ["observations/0", *made]}
    store.tables.merge("runs", [{**run, "result": json.dumps(RESULT)}])
    store.tables.merge("artefacts", [{"artefact_id": one, "num_bytes": 40} for one in made])
    name = {"protocol": "recorded", "trajectory": "recorded", "name": "psnr"}
    scores = [
        {"metric_id": variant, "run_id": "run", **name, "variant": variant, "value": value}
        for variant, value in judged.items()
    ]
    store.tables.merge("metrics", scores)
    ledger = FleetLedger(store)
    ledger.ask([wish()])
    lease = ledger.take(ledger.rows("night")[0], {})
    assert ledger.end(lease, Ending(cause="done", run_id="run", seconds=2.0))
    (point,), missing = points_of(store, "night")
    assert missing == []
    return point


@pytest.mark.parametrize(
    ("fitted", "judged", "at_end"),
    [
        (2, {"unpainted": 20.0, "painted": 21.0, "view-time": 22.0}, 21.0),
        (2, {"unpainted": 20.0, "refined": 19.0}, 19.0),
        (2, {"unpainted": 20.0}, None),
        (1, {"unpainted": 20.0}, 20.0),
        (1, {"unpainted": 20.0, "painted": 20.0, "view-time": 22.0}, 20.0),
        (1, {"painted": 21.0}, 21.0),  # an edited run has no first fit
    ],
)
def test_numbers_of_the_first_fit_are_those_of_the_end_only_without_rounds(
    tmp_path, fitted, judged, at_end
):
    point = point_of(open_store(tmp_path), fitted=fitted, judged=judged)
    assert point.metrics.get(("recorded", "recorded", "psnr")) == at_end
    assert {variant: max(found.values()) for variant, found in point.by_variant.items()} == judged


def test_cost_is_that_of_making_the_scene_not_of_judging_it(tmp_path):
    point = point_of(open_store(tmp_path), fitted=1, judged={"unpainted": 20.0})
    assert point.cost == {
        "seconds": 3.0,
        "cpu_seconds": 5.0,
        "peak_memory_bytes": 100,
        "num_gaussians": 10,
        "scene_bytes": 40,
    }
