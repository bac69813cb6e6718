"""How long the questions about a whole store take: `python tests/benchmarks/bench_questions.py`.

A catalog of so many scenes, each with one run of eight artefacts and one attempt of a fleet, is
written by numbers; then it is asked what is stale since one module changed and what a scene has
cost. Finding today's code from the source, which does not grow with the catalog, is timed apart.
"""

import json
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from catalog.code_closure import Code
from catalog.questions import cost_of, stale_runs
from catalog.store import open_store
from tasks.source import code_behind

KINDS = ("observations", "gaussians", "guidance", "gaussians", "evaluation", "evaluation", "report")
STARTS = ["tasks.reconstruction.fit:_build"]
BATCH = 20_000
BEFORE = Code(tuple(STARTS), {"library": "1"})
AFTER = Code(tuple(STARTS), {"library": "2"})


def artefacts(scene):
    """The artefacts of one scene, each made from the one before."""
    before = f"content-{scene}"
    for position, kind in enumerate(KINDS):
        digest = f"{scene:026d}{position:06d}"
        yield {
            "artefact_id": f"{kind}/{digest}",
            "kind": kind,
            "inputs": json.dumps({"input": before}),
            "source_digest": BEFORE.digest,
            "starts": STARTS,
            "seconds": 1.0,
            "num_bytes": 1,
            "summary": '{"cpu_seconds": 2.0}',
        }
        before = digest


def fill(store, scenes):
    """Write the rows of so many scenes."""
    now = datetime.now(UTC)
    rows: dict[str, list[dict[str, Any]]] = {
        "scenes": [],
        "runs": [],
        "artefacts": [],
        "attempts": [],
    }
    for number in range(scenes):
        scene, made = f"toy/{number}", list(artefacts(number))
        rows["artefacts"] += made
        rows["scenes"].append({"scene_id": scene, "content_digest": f"content-{number}"})
        run = {"run_id": f"run-{number}", "scene_id": scene, "parameters": "{}"}
        names = [one["artefact_id"] for one in made]
        ended = {"status": "complete", "finished_at": now, "artefacts": names}
        rows["runs"].append({**run, **ended})
        took = {"seconds": 7.0, "cpu_seconds": 14.0, "cause": "done", "fleet": "night"}
        rows["attempts"].append({"attempt_id": str(number), "scene_id": scene, **took})
    for table, found in rows.items():
        for start in range(0, len(found), BATCH):
            store.tables.merge(table, found[start : start + BATCH])


def timed(what, ask):
    """Ask and print what it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    answer = ask()
    took = time.perf_counter() - wall, time.process_time() - cpu
    sys.stdout.write(f"{what:30s} {took[0]:6.2f} s {took[1]:6.2f} CPU s\n")
    return answer


def ask(store):
    """Ask what grows with the catalog."""
    timed("nothing is stale", lambda: stale_runs(store, lambda _starts: BEFORE))
    timed("everything is stale", lambda: stale_runs(store, lambda _starts: AFTER))
    timed("what a scene has cost", lambda: cost_of(store, "toy/0"))


def main(counts):
    """Print a block for each number of scenes."""
    timed("today's code of a fit", lambda: [code_behind(start) for start in STARTS])
    for scenes in counts:
        with tempfile.TemporaryDirectory() as folder:
            store = open_store(Path(folder))
            fill(store, scenes)
            sys.stdout.write(f"{scenes} scenes, {scenes * len(KINDS)} artefacts\n")
            ask(store)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [1000, 10_000])
