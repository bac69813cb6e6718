"""A fleet in Prefect's hands: what is deployed, what is refused, and that it fires by itself."""

import inspect
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from chaos import Site
from commands import call
from production_services import NO_POSTGRES
from stub_fleet import stub_ledger, write_stub_manifest
from stub_stages import write_inputs
from waiting import until

from flows.fleet.deployed import deploy
from lidarpainter_models.errors import ConfigError

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "docs" / "examples" / "deploy"
DEPLOYED = yaml.safe_load((ROOT / "prefect.yaml").read_text("utf-8"))["deployments"]
LONGEST_S = 600.0


def parameters(store, workers=2):
    return {"manifest": "/logs/night.toml", "store": str(store), "workers": workers}


@pytest.mark.parametrize("deployment", DEPLOYED, ids=lambda deployment: deployment["name"])
def test_what_the_project_deploys_names_a_flow_and_its_parameters(deployment):
    path, _, name = deployment["entrypoint"].partition(":")
    flow = getattr(import_module(path.removesuffix(".py").replace("/", ".")), name)
    known = inspect.signature(flow.fn).parameters
    assert set(deployment.get("parameters", {})) <= set(known)


def test_a_fleet_is_deployed_once_and_changed_by_doing_it_again(client, tmp_path):
    told = deploy("night", parameters(tmp_path), pool="nights", cron="*/15 * * * *")
    assert told["worker"] == "prefect worker start --pool nights --limit 3"
    assert client.read_work_pool("nights").type == "process"
    again = parameters(tmp_path, workers=5)
    deploy("night", again, pool="nights", cron="0 3 * * *", threads=2)
    firing = client.read_deployment_by_name("fleet/night")
    assert [one.schedule.cron for one in firing.schedules] == ["0 3 * * *"]
    assert firing.parameters["workers"] == 5
    assert firing.entrypoint == "flows.fleet.deployed.fleet"
    worker = client.read_deployment_by_name("fleet-work/night")
    assert worker.parameters == {"fleet": "night", "store": str(tmp_path)}
    assert worker.job_variables["env"]["OMP_NUM_THREADS"] == "2"
    assert worker.global_concurrency_limit is None
    with pytest.raises(ConfigError, match=f"night is deployed for the store {tmp_path}"):
        deploy("night", parameters(tmp_path / "other"), pool="nights", cron=None)


def test_without_a_schedule_it_fires_once_now(client, tmp_path):
    deploy("once", parameters(tmp_path), pool="nights", cron=None)
    deployment = client.read_deployment_by_name("fleet/once")
    runs = client.read_flow_runs()
    assert [run.state_name for run in runs if run.deployment_id == deployment.id] == ["Scheduled"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--deploy"], "expected PREFECT_API_URL to name the API"),
        (["--cron", "0 3 * * *"], "--cron needs --deploy"),
    ],
)
def test_what_cannot_be_deployed_is_refused_in_one_line(words, said, tmp_path, monkeypatch):
    from prefect.settings import PREFECT_API_URL, temporary_settings

    monkeypatch.setenv("LIDARPAINTER_STORE", str(tmp_path / "store"))
    manifest = write_stub_manifest(tmp_path)
    with temporary_settings({PREFECT_API_URL: None}):
        answer = call("--quiet", "fleet", "run", manifest, *words)
    assert answer.code == 2
    assert said in answer.err
    assert not (tmp_path / "store").exists()


def test_a_schedule_that_is_none_is_refused(prefect_api, tmp_path):  # noqa: ARG001 - the server
    with pytest.raises(ConfigError, match="--cron 'at noon': expected minute, hour"):
        deploy("noon", parameters(tmp_path), pool="nights", cron="at noon")


def test_the_compose_file_shows_nothing_outside_this_machine_and_holds_no_secret():
    services = yaml.safe_load((EXAMPLES / "compose.yaml").read_text("utf-8"))["services"]
    assert set(services) == {"database", "server", "worker"}
    ports = [port for one in services.values() for port in one.get("ports", [])]
    assert ports == ["127.0.0.1:4200:4200"]
    for one in services.values():
        assert not {name for name in one.get("environment", {}) if name.endswith("PASSWORD")}
        assert set(one.get("depends_on", [])) <= set(services)


def test_the_kubernetes_file_holds_what_it_refers_to_and_no_secret():
    documents = list(yaml.safe_load_all((EXAMPLES / "kubernetes.yaml").read_text("utf-8")))
    found = {(one["kind"], one["metadata"]["name"]): one for one in documents}
    server = found["Service", "prefect-server"]["spec"]
    assert ("Deployment", server["selector"]["app"]) in found
    for (kind, _name), one in found.items():
        if kind == "Deployment":
            template = one["spec"]["template"]
            assert one["spec"]["selector"]["matchLabels"] == template["metadata"]["labels"]
            for setting in template["spec"]["containers"][0]["env"]:
                assert "postgresql" not in setting.get("value", "")


@pytest.mark.slow
@pytest.mark.skipif(NO_POSTGRES is not None, reason=str(NO_POSTGRES))
def test_a_schedule_fires_by_itself_and_makes_only_what_is_new(tmp_path):
    scenes = [f"synthetic/street-{seed:04d}" for seed in (1, 2, 3)]
    write_inputs(tmp_path / "inputs", scenes, ())
    manifest = write_stub_manifest(tmp_path, "twice", sequences=2)
    inputs = tmp_path / "inputs"
    with Site(
        folder=tmp_path, store=tmp_path / "store", inputs=inputs, name="twice", num_workers=1
    ) as site:
        site.deploy(manifest, every_s=30)
        site.start_process_workers()
        until(lambda: site.status()["done"] == 2, seconds=LONGEST_S)
        first = stub_ledger(site.store).store.tables.rows("attempts")
        write_stub_manifest(tmp_path, "twice", sequences=3)
        until(lambda: site.status()["done"] == 3, seconds=LONGEST_S)
    attempts = stub_ledger(site.store).store.tables.rows("attempts")
    new = [row["scene_id"] for row in attempts if row not in first]
    assert (len(first), new) == (2, [scenes[2]])
