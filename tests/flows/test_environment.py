import os

import pytest

from catalog.errors import CatalogError
from catalog.folders import home_folder
from catalog.store import open_store
from flows import environment
from flows.cli.main import main
from flows.environment import keep_prefect_in, prepare_environment
from tasks.job_limits import usable_cores


@pytest.fixture
def bare_environment(monkeypatch):
    """No thread counts set; what is set meanwhile is taken back."""
    for name in list(os.environ):
        if name.endswith("_NUM_THREADS"):
            monkeypatch.delenv(name)
    monkeypatch.setattr(os, "environ", dict(os.environ))


@pytest.mark.usefixtures("bare_environment")
def test_threads_follow_the_usable_cores():
    prepare_environment()
    assert os.environ["NUMBA_NUM_THREADS"] == os.environ["OMP_NUM_THREADS"] == str(usable_cores())


@pytest.mark.usefixtures("bare_environment")
def test_what_the_user_set_stays():
    own = {"NUMBA_NUM_THREADS": "7", "OMP_WAIT_POLICY": "active", "PREFECT_LOGGING_LEVEL": "DEBUG"}
    os.environ.update(own)
    os.environ.pop("DO_NOT_TRACK", None)
    prepare_environment()
    assert {name: os.environ[name] for name in own} == own
    assert os.environ["DO_NOT_TRACK"] == "1"


@pytest.mark.usefixtures("bare_environment")
@pytest.mark.parametrize("known", ["", "intranet.example, localhost"])
def test_own_servers_are_reached_past_a_proxy(known):
    os.environ["http_proxy"] = "http://127.0.0.1:9"
    os.environ["no_proxy"] = known
    prepare_environment()
    hosts = os.environ["no_proxy"].split(",")
    own = {"127.0.0.1", "localhost", "::1"}
    assert sorted(hosts) == sorted({"intranet.example", *own} if known else own)
    assert os.environ["NO_PROXY"] == os.environ["no_proxy"]


@pytest.mark.usefixtures("bare_environment")
@pytest.mark.parametrize(
    "proxy", ["::not a proxy::", "http://", "proxy:80x", "socks4://proxy.example:1080"]
)
def test_a_proxy_that_cannot_be_used_is_left_out_and_named(proxy, capsys):
    os.environ["HTTP_PROXY"], os.environ["https_proxy"] = proxy, "proxy.example:3128"
    prepare_environment()
    assert "HTTP_PROXY" not in os.environ
    assert os.environ["https_proxy"] == "proxy.example:3128"
    assert f"HTTP_PROXY is left out: {proxy!r}" in capsys.readouterr().err


@pytest.mark.usefixtures("bare_environment")
@pytest.mark.parametrize("is_installed", [True, False])
def test_a_socks_proxy_stays_where_its_package_is_installed(is_installed, monkeypatch, capsys):
    monkeypatch.setattr(environment, "find_spec", lambda _name: object() if is_installed else None)
    os.environ["ALL_PROXY"] = "socks5://proxy.example:1080"
    prepare_environment()
    assert ("ALL_PROXY" in os.environ) == is_installed
    assert ("pip install socksio" in capsys.readouterr().err) != is_installed


@pytest.mark.usefixtures("bare_environment")
def test_prefect_lives_in_the_store_of_who_has_no_home_and_has_not_said_where(tmp_path):
    os.environ.pop("PREFECT_HOME", None)
    os.environ["HOME"] = str(tmp_path)
    keep_prefect_in(str(tmp_path / "one"))
    assert "PREFECT_HOME" not in os.environ
    os.environ["HOME"] = str(tmp_path / "none")
    keep_prefect_in(str(tmp_path / "one"))
    assert os.environ["PREFECT_HOME"] == str(tmp_path / "one" / "prefect")
    keep_prefect_in(str(tmp_path / "two"))
    assert os.environ["PREFECT_HOME"] == str(tmp_path / "two" / "prefect")
    os.environ["HOME"] = "/proc"  # is there, but holds no file of ours, not even root's
    keep_prefect_in(str(tmp_path / "one"))
    assert os.environ["PREFECT_HOME"] == str(tmp_path / "one" / "prefect")
    os.environ["PREFECT_HOME"] = "/mine"
    keep_prefect_in(str(tmp_path / "one"))
    assert os.environ["PREFECT_HOME"] == "/mine"
    assert list(tmp_path.iterdir()) == []


def test_who_has_neither_home_nor_name_is_served(bare_environment, monkeypatch, capsys):  # noqa: ARG001
    for name in ("HOME", "XDG_CACHE_HOME"):
        os.environ.pop(name, None)

    def nobody(_number):
        raise KeyError("uid not found")

    monkeypatch.setattr("pwd.getpwuid", nobody)
    assert home_folder() is None
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("lidarpainter ")
    with pytest.raises(CatalogError, match="~/store: there is no home folder, expected HOME"):
        open_store("~/store")
