"""A worker whose sequences cost nothing, and do what a file of the store says of them."""

import os
import sys
import time
from pathlib import Path

from catalog.fleets import FleetLedger
from catalog.leases import Leases
from catalog.store import open_store
from flows.fleet.asked_sequences import wishes
from flows.fleet.local_workers import log_path
from flows.fleet.manifest import read_manifest
from lidarpainter_models.errors import DataError

SCRIPT = Path(__file__)
ROOT = SCRIPT.parents[2]
MANIFEST = """
name = "{name}"
painter = "none"
[[source]]
dataset = "synthetic"
seeds = "1:{stop}"
frames = "0:4"
width_px = 64
cameras = ["front_camera"]
[budget]
free_disk_gb = 0
"""
TIME_TO_LIVE_S = 3.0


def write_stub_manifest(folder, name="stub", sequences=4, more=""):
    path = folder / f"{name}.toml"
    path.write_text(MANIFEST.format(name=name, stop=sequences + 1) + more)
    return path


def stub_ledger(root, **options):
    store = open_store(root)
    leases = Leases(store.objects("leases"), time_to_live_s=TIME_TO_LIVE_S)
    return FleetLedger(store, leases=leases, first_pause_s=0.0, **options)


def asked_ledger(root, manifest):
    """The ledger of a store, made if need be, of which a manifest was asked."""
    ledger = stub_ledger(root)
    ledger.store.make()
    ledger.ask(wishes(read_manifest(manifest), manifest.parent))
    return ledger


def behave(root, scene, what):
    """What becomes of a sequence: `bad`, `no memory`, `full`, `slow` (the first time alone)."""
    folder = Path(root) / "stub"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / scene.replace("/", "-")).write_text(what)


def stub_work(asked, store_path, _attempt):
    """Make nothing, and say that it is done."""
    from flows.fleet.work import Made

    path = store_path / "stub" / asked.scene_id.replace("/", "-")
    what = path.read_text() if path.exists() else "good"
    if what == "bad":
        raise DataError(f"{asked.scene_id}: the third image is damaged")
    if what == "no memory":
        raise MemoryError
    if what == "full":
        path.unlink()
        raise OSError(28, os.strerror(28))
    if what == "slow":
        path.unlink()
        time.sleep(120)
    return Made(run_id=f"run-{asked.sequence}", is_whole=False, num_bytes=0)


def stub_worker(root, fleet, say=lambda _line: None):
    from flows.fleet.worker import Worker

    ledger = stub_ledger(root)
    return Worker(ledger=ledger, fleet=fleet, work=stub_work, say=say, poll_s=0.2)


def stub_starter(root, fleet, _threads):
    """In place of `flows.fleet.local_workers.starter`."""
    from flows.server import start_child

    def start(number):
        path = log_path(Path(root), fleet, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{SCRIPT.parent}"}
        with path.open("ab") as log:
            words = [str(SCRIPT), str(root), fleet]
            return start_child(words, log=log.fileno(), environment=environment)

    return start


if __name__ == "__main__":
    stub_worker(sys.argv[1], sys.argv[2], say=lambda line: sys.stderr.write(f"{line}\n")).run()
