"""Chaos: a deployed fleet whose processes are killed thirty times, and what must hold after it.

`python tests/chaos/run_chaos.py` prints one JSON object and exits with 0 if all of it holds. It
needs Debian's postgresql, and to be root for the small disk (a tmpfs) that is full once. With
`--bucket` the store lies in a stand-in for S3 instead, which refuses and delays requests. Whatever
ends it ends all that it started.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from bucket_stand_in import BUCKET, running_stand_in  # noqa: E402
from chaos import Chaos, Site  # noqa: E402
from production_services import NO_POSTGRES  # noqa: E402
from stub_fleet import asked_ledger, stub_ledger, write_stub_manifest  # noqa: E402
from stub_stages import make, stages_ledger, write_inputs  # noqa: E402

from catalog.artefacts import ArtefactRef  # noqa: E402
from catalog.digests import digest_file  # noqa: E402
from catalog.store import open_store  # noqa: E402
from flows.fleet.flow_runs import close_lost_runs  # noqa: E402
from flows.fleet.status import fleet_status  # noqa: E402
from flows.fleet.worker import Worker  # noqa: E402

NAME = "chaos"
EVERY_S = 30
DISK_MEGABYTES = 256
CALM_S = 1800.0
ENDINGS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


def main() -> None:
    """Run it and say what holds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=int, default=100)
    parser.add_argument("--corrupted", type=int, default=10)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bucket", action="store_true")
    parser.add_argument("--pace-s", type=float, default=2.0, help="what a stage takes")
    arguments = parser.parse_args()
    if NO_POSTGRES:
        sys.exit(NO_POSTGRES)
    for number in ENDINGS:
        signal.signal(number, end)
    found = run_chaos(**vars(arguments))
    print(json.dumps(found, indent=1))  # noqa: T201
    sys.exit(0 if found["holds"] else 1)


def end(number, _frame):
    """Leave as after an error; a second signal does not keep what was started from being ended."""
    for one in ENDINGS:
        signal.signal(one, signal.SIG_IGN)
    sys.exit(128 + number)


def run_chaos(*, sequences, corrupted, kills, seed, pace_s, bucket=False):
    """What was killed, what came of the fleet, and what is amiss."""
    folder = Path(tempfile.mkdtemp(prefix="lp-chaos-"))
    scenes = [f"synthetic/street-{seed:04d}" for seed in range(1, sequences + 1)]
    bad = scenes[3 :: max(1, sequences // corrupted)][:corrupted]
    write_inputs(folder / "inputs", scenes, bad)
    manifest = write_stub_manifest(folder, NAME, sequences)
    began = time.monotonic()
    with in_bucket(folder) if bucket else on_small_disk(folder) as (store, disturb, is_small):
        with Site(
            folder=folder, store=store, inputs=folder / "inputs", name=NAME, pace_s=pace_s
        ) as site:
            site.deploy(manifest, EVERY_S)
            site.start_process_workers()
            chaos = Chaos(
                site=site,
                seed=seed,
                kills=kills,
                is_disk_small=is_small,
                disturb_bucket=disturb,
                say=tell,
            )
            chaos.run()
            retried = calm(site, sequences)
            open_runs = settled(site)
            status = fleet_status(stub_ledger(site.store), NAME)
        wrong = faults(site.store, status, scenes, bad, undisturbed(folder, manifest))
    if open_runs:
        wrong.append(f"open in Prefect: {open_runs}")
    return {
        "holds": not wrong,
        "wrong": wrong,
        "counts": status["counts"],
        "killed": chaos.killed,
        "disk_was_full": is_small,
        "bucket": bucket,
        "retried_after_three_kills": retried,
        "attempts": status["cost"]["attempts"],
        "minutes": round((time.monotonic() - began) / 60, 1),
        "folder": str(folder),
    }


@contextmanager
def on_small_disk(folder):
    """A place for a store on a disk of its own, if this user may mount one."""
    disk = folder / "disk"
    disk.mkdir()
    try:
        yield str(disk / "store"), None, os.geteuid() == 0 and mounted(disk)
    finally:
        if disk.is_mount():
            subprocess.run(["umount", disk], check=True)  # noqa: S607


@contextmanager
def in_bucket(folder):
    """A place for a store in a bucket, and what makes it refuse and delay requests for a while."""
    with running_stand_in() as stand_in:
        os.environ.update(stand_in.environment, LIDARPAINTER_CACHE=str(folder / "cache"))

        def disturb():
            stand_in.fail(before=40, after=20, every=5, slow_s=0.02)

        yield f"s3://{BUCKET}/chaos", disturb, False


def mounted(disk: Path) -> bool:
    """Whether a small disk of its own lies there now."""
    size = f"size={DISK_MEGABYTES}m"
    words = ["mount", "-t", "tmpfs", "-o", size, "tmpfs", str(disk)]
    return subprocess.run(words, check=False, stderr=subprocess.DEVNULL).returncode == 0


def calm(site: Site, sequences: int) -> list[str]:
    """Wait until the fleet is over; whoever was killed three times is tried again by hand."""
    retried: list[str] = []
    deadline = time.monotonic() + CALM_S
    while True:
        assert time.monotonic() < deadline, "the fleet does not end"
        time.sleep(5.0)
        site.tend()
        counts = site.status()
        tell(str(counts))
        if counts["done"] + counts["set-aside"] == sequences:
            return retried
        if counts["failed"] and not counts["waiting"] + counts["running"]:
            retried += stub_ledger(site.store).retry(NAME)


def settled(site: Site) -> list[str]:
    """End the schedule, and say what is open in Prefect after all of that is over."""
    site.unschedule()
    deadline = time.monotonic() + 600.0
    while found := [f"{run.name} {run.state_name}" for run in site.open_runs()]:
        if time.monotonic() > deadline:
            break
        time.sleep(10.0)
        site.tend()
        ledger = stages_ledger(open_store(site.store))
        with site.client():
            tell(f"{ledger.reconcile()} {close_lost_runs(ledger)}")
    return found


def undisturbed(folder: Path, manifest: Path) -> Path:
    """The same fleet in a store of its own, one sequence after the other."""
    os.environ.update({"STUB_INPUTS": str(folder / "inputs"), "STUB_PACE_S": "0"})
    ledger = asked_ledger(folder / "undisturbed", manifest)
    Worker(
        ledger=ledger,
        fleet=NAME,
        work=lambda asked, store, _attempt: make(asked, store),
        say=lambda _line: None,
    ).run()
    return ledger.store.root


def faults(store, status, scenes, bad, calm_store):
    """What is not as it should be, a line each."""
    states, wrong = {one["scene"]: one for one in status["sequences"]}, []
    for scene in scenes:
        found, reason = states[scene]["state"], states[scene]["reason"] or ""
        if scene in bad and (found != "set-aside" or scene.replace("/", "-") not in reason):
            wrong.append(f"{scene}: {found} because {reason!r}, expected set-aside")
        if scene not in bad and found != "done":
            wrong.append(f"{scene}: {found}, expected done")
    if files(store) != files(calm_store):
        wrong.append("files of artefacts differ from those of the undisturbed run")
    ledger = stub_ledger(store)
    held = [*ledger.leases.held(), *ledger.flow_runs.held()]
    wrong += [f"lease {lease.name} is held" for lease in held]
    if ledger.store.mirror is None:
        left = [path for name in ("aside", "work") for path in (Path(store) / name).glob("*")]
        wrong += [f"{path} is left over" for path in sorted(left)]
    return wrong + wrong_rows(ledger.store.tables, stub_ledger(calm_store).store.tables)


def wrong_rows(tables, calm_tables):
    """Rows that are lost or doubled, a line each."""
    wrong = []
    for table in ("runs", "artefacts", "sequences"):
        ids = [next(iter(row.values())) for row in tables.rows(table)]
        expected = [next(iter(row.values())) for row in calm_tables.rows(table)]
        if sorted(ids) != sorted(expected):
            wrong.append(f"{table}: {len(ids)} rows, expected {len(expected)}")
    attempts = tables.rows("attempts")
    if len({row["attempt_id"] for row in attempts}) != len(attempts):
        wrong.append("attempts: a row is doubled")
    entered = Counter(row["sequence_id"] for row in attempts)
    for row in tables.rows("sequences"):
        if entered[row["sequence_id"]] != row["attempts"]:
            found = f"{row['attempts']} attempts, {entered[row['sequence_id']]} rows of them"
            wrong.append(f"{row['scene_id']}: {found}")
    return wrong


def files(store) -> dict[str, str]:
    """Digest of every file of every artefact but its manifest, which says when it was made."""
    artefacts = open_store(store).artefacts
    return {
        f"{artefact_id}/{path.name}": digest_file(path)
        for artefact_id in artefacts.ids()
        for path in artefacts.files(ArtefactRef.of_id(artefact_id)).iterdir()
        if path.name != "manifest.json"
    }


def tell(line: str) -> None:
    """How far it is."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {line}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
