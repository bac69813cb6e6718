"""A bucket on loopback: moto's S3, one request at a time, with faults on demand.

moto looks at a condition and writes in two steps, so requests are let in one after another: a
conditional put is then as atomic as Amazon's. Faults are asked for at `/-/faults`: how many of the
next requests are refused with 503 before they are carried out, or answered so after they were, or
kept waiting.
"""

import json
import os
import secrets
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager
from typing import Any

import pytest

PRIVATE_WORD = "not-a-secret-of-anybody"
ENVIRONMENT = {
    "AWS_ACCESS_KEY_ID": "tests",
    "AWS_SECRET_ACCESS_KEY": PRIVATE_WORD,
    "AWS_REGION": "us-east-1",
}
BUCKET = "drives"
REFUSED = b"<Error><Code>SlowDown</Code><Message>injected</Message></Error>"


class StandIn:
    """A running stand-in."""

    def __init__(self, endpoint):
        self.endpoint = endpoint
        self.environment = {**ENVIRONMENT, "AWS_ENDPOINT_URL": endpoint}

    def make_bucket(self, name=BUCKET):
        self._ask(f"/{name}", "PUT")

    def fail(self, *, before=0, after=0, every=1, slow_s=0.0, only=""):
        """From now on: `before` requests refused, `after` carried out and then refused, and so on.

        Only every so manieth request counts, and only those whose method and path hold `only`.
        """
        faults = {"before": before, "after": after, "every": every, "slow_s": slow_s, "only": only}
        self._ask("/-/faults", "POST", json.dumps(faults).encode())

    def requests(self):
        """Method and path of every request so far."""
        return json.loads(self._ask("/-/requests", "GET"))

    def _ask(self, path, method, body=None):
        request = urllib.request.Request(self.endpoint + path, method=method, data=body)  # noqa: S310
        with urllib.request.urlopen(request, timeout=30) as answer:  # noqa: S310
            return answer.read()


class _Gate:
    """In front of moto."""

    def __init__(self, application):
        self.application = application
        self.faults: dict[str, Any] = {
            "before": 0,
            "after": 0,
            "every": 1,
            "slow_s": 0.0,
            "only": "",
        }
        self.seen: list[str] = []
        self.turn = threading.Lock()

    def __call__(self, environ, start_response):
        path, method = environ["PATH_INFO"], environ["REQUEST_METHOD"]
        if path == "/-/faults":
            self.faults = json.loads(environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"])))
            return _answered(start_response, "200 OK", b"")
        if path == "/-/requests":
            return _answered(start_response, "200 OK", json.dumps(self.seen).encode())
        with self.turn:
            self.seen.append(f"{method} {path}?{environ.get('QUERY_STRING', '')}")
            fault = self._fault(f"{method} {path}")
            if fault == "before":
                environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
                return _answered(start_response, "503 Slow Down", REFUSED)
            if fault == "after":
                b"".join(self.application(environ, lambda *_: None))
                return _answered(start_response, "503 Slow Down", REFUSED)
            answer = list(self.application(environ, start_response))
        if self.faults["slow_s"]:
            time.sleep(self.faults["slow_s"])
        return answer

    def _fault(self, request):
        counts = self.faults["only"] in request and len(self.seen) % self.faults["every"] == 0
        for kind in ("before", "after"):
            if counts and self.faults[kind] > 0:
                self.faults[kind] -= 1
                return kind
        return None


def _answered(start_response, status, body):
    start_response(status, [("Content-Type", "text/plain"), ("Content-Length", str(len(body)))])
    return [body]


@contextmanager
def running_stand_in():
    """A stand-in in a process of its own, with one empty bucket."""
    words = [sys.executable, "-W", "ignore", __file__]
    environment = {**os.environ, **ENVIRONMENT}
    with subprocess.Popen(words, stdout=subprocess.PIPE, env=environment) as process:
        assert process.stdout is not None
        try:
            stand_in = StandIn(f"http://127.0.0.1:{int(process.stdout.readline())}")
            stand_in.make_bucket()
            yield stand_in
        finally:
            process.kill()


@pytest.fixture(scope="session")
def _running_stand_in():
    with running_stand_in() as found:
        yield found


@pytest.fixture
def stand_in(_running_stand_in, tmp_path, monkeypatch):
    """The stand-in without faults, found by this process and its children."""
    _running_stand_in.fail()
    for name, value in _running_stand_in.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("LIDARPAINTER_CACHE", str(tmp_path / "cache"))
    return _running_stand_in


@pytest.fixture
def address(stand_in):  # noqa: ARG001 - it is found through the environment
    """An empty place in its bucket."""
    return f"s3://{BUCKET}/{secrets.token_hex(6)}"


@pytest.fixture(params=["folder", "bucket"])
def any_address(request, tmp_path):
    """A folder or a place in a bucket, for what holds of both."""
    if request.param == "folder":
        return str(tmp_path / "store")
    return request.getfixturevalue("address")


def _serve():
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Silent(WSGIRequestHandler):
        protocol_version = "HTTP/1.1"  # connections are kept, as by the real one

        def log(self, *_):
            pass

    moto = DomainDispatcherApplication(create_backend_app)
    server = make_server("127.0.0.1", 0, _Gate(moto), threaded=True, request_handler=Silent)
    sys.stdout.write(f"{server.port}\n")
    sys.stdout.flush()
    server.serve_forever()


if __name__ == "__main__":
    _serve()
