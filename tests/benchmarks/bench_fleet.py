"""What a fleet costs beside its stages: CPU seconds a sequence, with stages that do nothing.

`python tests/benchmarks/bench_fleet.py 10 100` asks for so many streets, lets one worker go through
them, and asks for them again. Starting up (imports) is not in the figures, commits to the tables
are. `--prefect` makes each sequence a flow run against a server of its own on PostgreSQL, and the
CPU time of both counts. `--bucket` has the store in a stand-in for a bucket, whose time does not.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from flows.environment import prepare_environment  # noqa: E402

prepare_environment()

import psutil  # noqa: E402
from bucket_stand_in import BUCKET, running_stand_in  # noqa: E402
from production_services import Postgres, PrefectService  # noqa: E402
from stub_fleet import stub_ledger, stub_work, stub_worker, write_stub_manifest  # noqa: E402

from flows.fleet import work  # noqa: E402
from flows.fleet.asked import Asked, wishes  # noqa: E402
from flows.fleet.manifest import read_manifest  # noqa: E402
from flows.fleet.status import fleet_status, is_over  # noqa: E402


def cpu_seconds() -> float:
    """Of this process, of those it has started, and of PostgreSQL's, which leave their parent."""
    others = psutil.Process().children(recursive=True)
    for process in psutil.process_iter(["cmdline"]):
        if any(Postgres.PREFIX in word for word in process.info["cmdline"] or []):
            others += [process, *process.children()]
    # user and system time, of a server's children that have ended too
    return time.process_time() + sum(sum(process.cpu_times()[:4]) for process in set(others))


def measured(number: int, *, as_flows: bool, bucket: str | None = None) -> tuple[float, float]:
    """CPU seconds a sequence of the first time and of the second."""
    cpu = time.process_time if bucket else cpu_seconds
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = write_stub_manifest(folder, sequences=number)
        began = cpu()
        ledger = stub_ledger(f"{bucket}/{number}" if bucket else folder / "store")
        ledger.store.make()
        ledger.ask(wishes(read_manifest(path), folder))
        worker = stub_worker(ledger.store.address, "stub")
        worker.work = _as_flow if as_flows else stub_work
        worker.run()
        first = cpu() - began
        rows = ledger.rows("stub")
        complete = {"status": "complete", "artefacts": []}
        ledger.store.tables.merge("runs", [{"run_id": row["run_id"], **complete} for row in rows])
        began = cpu()
        ledger.ask(wishes(read_manifest(path), folder))
        assert is_over(fleet_status(ledger, "stub"))
        return first / number, (cpu() - began) / number


def _as_flow(asked: Asked, store: Path, attempt: str) -> work.Made:
    """As a worker makes a sequence, with stages that do nothing."""
    work._made = lambda asked, store_path: stub_work(asked, store_path, attempt)
    return work.make_sequence(asked, store, attempt)


@contextmanager
def _prefect(folder: Path) -> Iterator[None]:
    """A server on PostgreSQL for as long as the block runs."""
    from prefect.settings import PREFECT_API_URL, temporary_settings

    postgres = Postgres()
    service = PrefectService(folder, postgres.url)
    try:
        postgres.start()
        service.start()
        with temporary_settings({PREFECT_API_URL: service.url}):
            yield
    finally:
        service.end()
        postgres.remove()


def main() -> None:
    """Measure and print a line for each number of sequences."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("numbers", type=int, nargs="+")
    parser.add_argument("--prefect", action="store_true")
    parser.add_argument("--bucket", action="store_true")
    arguments = parser.parse_args()
    measured(2, as_flows=False)  # code that is read, tables' first use
    with (
        tempfile.TemporaryDirectory() as name,
        _prefect(Path(name)) if arguments.prefect else nullcontext(),
        running_stand_in() if arguments.bucket else nullcontext() as stand_in,
    ):
        if stand_in:
            os.environ |= {**stand_in.environment, "LIDARPAINTER_CACHE": name}
        for number in arguments.numbers:
            bucket = f"s3://{BUCKET}/bench" if stand_in else None
            first, second = measured(number, as_flows=arguments.prefect, bucket=bucket)
            print(f"{number} sequences: {first:.3f} s each, again {second:.4f} s each")  # noqa: T201


if __name__ == "__main__":
    main()
