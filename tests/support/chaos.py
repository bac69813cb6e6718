"""What happens to a deployed fleet: what is killed, restarted and filled, by a seeded order.

Two process workers of a pool, a Prefect server and PostgreSQL stand as under a service manager:
what is killed of them is started again. Firings and workers of the fleet are left to the fleet.
"""

import os
import random
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from production_services import ROOT, Postgres, PrefectService
from stub_fleet import stub_ledger

from catalog.errors import UnknownRecordError
from flows.fleet.status import counts_of

POOL = "chaos"
TARGETS = {"flow at work": 13, "flow that begins": 6, "process worker": 7, "server": 4}
"""Of thirty kills; who works has a sequence in hand."""


@dataclass(kw_only=True)
class Site:
    """A fleet in production, small; `with` it, its services run."""

    folder: Path
    store: str
    """A folder or an address."""
    inputs: Path
    name: str
    num_workers: int = 2
    pace_s: float = 0.0
    postgres: Postgres = field(default_factory=Postgres)
    process_workers: list[subprocess.Popen] = field(default_factory=list)

    def __post_init__(self):
        self.prefect = PrefectService(self.folder / "prefect", self.postgres.url)

    def __enter__(self):
        try:
            self.postgres.start()
            self.prefect.start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_error):
        self.prefect.end()
        self.postgres.remove()

    @property
    def environment(self):
        return {
            **self.prefect.environment,
            "LIDARPAINTER_STORE": self.store,
            "STUB_INPUTS": str(self.inputs),
            "STUB_PACE_S": str(self.pace_s),
            "PREFECT_RUNNER_POLL_FREQUENCY": "5",
            "PREFECT_WORKER_QUERY_SECONDS": "5",
        }

    def status(self):
        """How many sequences are in each state; none before the first firing."""
        with suppress(UnknownRecordError):
            return counts_of(stub_ledger(self.store).rows(self.name))
        return counts_of([])

    @contextmanager
    def client(self):
        """Of Prefect's API."""
        from prefect.client.orchestration import get_client
        from prefect.settings import PREFECT_API_URL, temporary_settings

        own = temporary_settings({PREFECT_API_URL: self.prefect.url})
        with own, get_client(sync_client=True) as client:
            yield client

    def open_runs(self):
        """Flow runs that Prefect shows as neither ended nor yet to come."""
        from prefect.client.schemas.filters import (
            FlowRunFilter,
            FlowRunFilterState,
            FlowRunFilterStateType,
        )
        from prefect.client.schemas.objects import StateType

        types = [StateType(one) for one in ("PENDING", "RUNNING", "CANCELLING", "PAUSED")]
        state = FlowRunFilterState(type=FlowRunFilterStateType(any_=types))
        with self.client() as client:
            return client.read_flow_runs(flow_run_filter=FlowRunFilter(state=state))

    def deploy(self, manifest, every_s):
        """The command that production uses; then flows whose stages are small."""
        cron = f"* * * * * */{every_s}"
        words = ["--workers", str(self.num_workers), "--pool", POOL, "--cron", cron]
        subprocess.run(
            [sys.executable, "-m", "flows.cli", "fleet", "run", manifest, "--deploy", *words],
            env=self.environment,
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            check=True,
        )
        from prefect.client.schemas.actions import DeploymentUpdate

        with self.client() as client:
            for flow in ("fleet", "fleet-work"):
                found = client.read_deployment_by_name(f"{flow}/{self.name}")
                where = f"stub_stages.{flow.replace('-', '_')}"
                client.update_deployment(found.id, DeploymentUpdate(entrypoint=where))

    def unschedule(self):
        """No firing any more, and none that waits."""
        with self.client() as client:
            client.pause_deployment(client.read_deployment_by_name(f"fleet/{self.name}").id)

    def start_process_workers(self):
        for number in range(self.num_workers):
            self.process_workers.append(self._process_worker(number))

    def tend(self):
        """Start again what was killed of the services."""
        for number, process in enumerate(self.process_workers):
            if process.poll() is not None:
                self.process_workers[number] = self._process_worker(number)
        if self.prefect.process.poll() is not None:
            self.prefect.start()

    def flows(self):
        """Processes of flow runs, by whether they have a sequence in hand."""
        at_work = {lease.holder.process_id for lease in stub_ledger(self.store).leases.held()}
        found: dict[str, list[psutil.Process]] = {"flow at work": [], "flow that begins": []}
        for process in psutil.process_iter(["pid", "cmdline"]):
            with suppress(psutil.Error):
                words = process.info["cmdline"] or []
                is_flow = any(word in ("prefect.engine", "prefect.flow_engine") for word in words)
                if is_flow and process.environ().get("PREFECT_HOME") == str(self.prefect.folder):
                    has_begun = process.info["pid"] in at_work
                    found["flow at work" if has_begun else "flow that begins"].append(process)
        return found

    def restart_postgres(self, down_s):
        self.postgres.stop()
        time.sleep(down_s)
        self.postgres.start()

    def _process_worker(self, number):
        words = ["worker", "start", "--pool", POOL, "--limit", "2", "--name", f"worker-{number}"]
        return self.prefect.spawn(words, f"worker-{number}", self.environment)


@dataclass(kw_only=True)
class Chaos:
    """Thirty kills in a seeded order, with what else happens between them."""

    site: Site
    seed: int
    kills: int
    is_disk_small: bool
    """Whether the store lies on a disk that can be filled."""
    disturb_bucket: Callable[[], object] | None = None
    """Called where a disk would be filled; None where there is no bucket."""
    say: Callable[[str], object] = print
    killed: dict[str, int] = field(default_factory=dict)

    def run(self):
        generator = random.Random(self.seed)  # noqa: S311 - an order, not a secret
        order = [name for name, count in TARGETS.items() for _ in range(count)]
        generator.shuffle(order)
        order = (order * (self.kills // len(order) + 1))[: self.kills]
        events = {
            self.kills // 3: ("PostgreSQL restarted", lambda: self.site.restart_postgres(5.0)),
            self.kills // 2: ("storage disturbed", self.fill_disk),
            2 * self.kills // 3: ("PostgreSQL restarted", lambda: self.site.restart_postgres(5.0)),
        }
        for number, target in enumerate(order):
            if number in events:
                what, happen = events[number]
                self.say(f"{what}")
                happen()
            time.sleep(generator.uniform(1.0, 6.0))
            self.kill(target, generator)
            self.site.tend()
            self.say(f"kill {number + 1}: {target}")

    def kill(self, target, generator):
        """Kill one of a kind, as soon as there is one."""
        if target == "server":
            self.site.prefect.kill()
        elif target == "process worker":
            process = generator.choice(self.site.process_workers)
            process.kill()
            process.wait()
        else:
            deadline = time.monotonic() + 240.0
            while not (found := self.site.flows()[target]):
                assert time.monotonic() < deadline, f"no {target} to kill"
                self.site.tend()
                time.sleep(0.3)
            generator.choice(found).kill()
        self.killed[target] = self.killed.get(target, 0) + 1

    def fill_disk(self, full_s=20.0):
        if self.disturb_bucket is not None:
            self.disturb_bucket()
        if not self.is_disk_small:
            return
        ballast = Path(self.site.store).parent / "ballast"
        with suppress(OSError), ballast.open("wb") as file:
            while True:
                file.write(bytes(1 << 16))
                file.flush()
                os.fsync(file.fileno())
        time.sleep(full_s)
        ballast.unlink()
