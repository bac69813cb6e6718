"""Flows that a pool runs whose stages make few bytes, the same ones every time.

The input of a sequence is a small file with its own digest in front; two stages stretch it. How
long they take is said by `STUB_PACE_S`, where the inputs lie by `STUB_INPUTS`.
"""

import hashlib
import os
import time
from functools import partial
from pathlib import Path
from typing import Any

from stub_fleet import TIME_TO_LIVE_S

from catalog.artefacts import ArtefactRef, Recipe
from catalog.code_closure import Code
from catalog.leases import Leases
from catalog.records import artefact_row
from catalog.store import open_store
from flows.fleet import deployed, flow_runs, work
from flows.fleet.deployed import fleet, fleet_work
from flows.fleet.worker import Worker
from lidarpainter_models.errors import DataError

__all__ = ["fleet", "fleet_work", "make", "stages_ledger", "write_inputs"]
KINDS = ("observations", "gaussians")
NUM_BYTES = 20_000
CODE = Code(starts=("stub_stages:make",), modules={})
DIGEST_BYTES = 32
FIRST_PAUSE_S = 1.0
BEGIN_S = 90.0
"""Shorter than in production: a test waits for what was killed before it began."""


def write_inputs(folder, scenes, corrupted):
    """One input a scene; those that are named hold a flipped bit."""
    folder.mkdir(parents=True)
    for scene in scenes:
        content = hashlib.shake_256(scene.encode()).digest(1000)
        digest = hashlib.sha256(content).digest()
        if scene in corrupted:
            content = bytes([content[0] ^ 1]) + content[1:]
        input_of(folder, scene).write_bytes(digest + content)


def input_of(folder, scene):
    return folder / f"{scene.replace('/', '-')}.bin"


def make(asked, store_path):
    """In place of `flows.fleet.work._made`."""
    path = input_of(Path(os.environ["STUB_INPUTS"]), asked.scene_id)
    whole = path.read_bytes()
    digest, content = whole[:DIGEST_BYTES], whole[DIGEST_BYTES:]
    if hashlib.sha256(content).digest() != digest:
        raise DataError(f"{path.name}: its bytes are not those that its digest was made of")
    store = open_store(store_path)
    refs: list[ArtefactRef] = []
    for kind in KINDS:
        source = refs[-1].digest if refs else digest.hex()
        recipe = Recipe(kind=kind, inputs={"scene": source}, config={}, code=CODE)
        ref, _is_new = store.artefacts.produce(recipe, partial(_build, source))
        row = artefact_row(ref, store.artefacts.manifest(ref))
        store.tables.merge("artefacts", [row])
        refs.append(ref)
    run_id = f"run-{asked.sequence}"
    artefacts = [ref.artefact_id for ref in refs]
    row = {"run_id": run_id, "scene_id": asked.scene_id, "status": "complete"}
    store.tables.merge("runs", [{**row, "artefacts": artefacts}])
    return work.Made(run_id=run_id, is_whole=False, num_bytes=NUM_BYTES * len(KINDS))


def _build(source, place):
    time.sleep(float(os.environ.get("STUB_PACE_S", "0")))
    (place.output / "bytes").write_bytes(hashlib.shake_256(source.encode()).digest(NUM_BYTES))


def stages_ledger(store):
    leases = Leases(store.objects("leases"), time_to_live_s=5 * TIME_TO_LIVE_S)
    return _Ledger(store, leases=leases, first_pause_s=FIRST_PAUSE_S)


_Ledger = deployed.FleetLedger
if "STUB_INPUTS" in os.environ:  # in a process of the pool, not where tests are collected
    replaced: Any = deployed
    replaced.FleetLedger = stages_ledger
    replaced.Worker = partial(Worker, poll_s=0.5)
    flow_runs.BEGIN_S = BEGIN_S
    work._made = make
