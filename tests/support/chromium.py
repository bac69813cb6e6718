"""Debian's Chromium without a screen, driven by its devtools protocol.

with Chromium(folder, width_px=480, height_px=270) as browser:
    browser.open("file:///tmp/page.html")
    browser.value("document.title")
"""

import base64
import json
import os
import shutil
import signal
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import until

NAMES = ("chromium", "chromium-browser", "google-chrome")
WORDS = ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--remote-debugging-port=0")
SOFTWARE_WEBGL = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")
NO_WEBGL = ("--disable-3d-apis",)
CANVAS = "[...document.querySelectorAll('canvas')].sort((a, b) => b.width - a.width)[0]"


def found_browser():
    """Its path; a test that needs one skips where there is none."""
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser here: none of {', '.join(NAMES)}")
    return found


class Chromium:
    """One browser with one tab; it ends with its block."""

    def __init__(self, folder: Path, *, width_px, height_px, words=SOFTWARE_WEBGL):
        size = f"--window-size={width_px},{height_px}"
        command = [found_browser(), *WORDS, *words, f"--user-data-dir={folder}", size]
        self.folder, self._number = Path(folder), 0
        self.events: list[dict[str, Any]] = []
        self._size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1}
        self._process = subprocess.Popen(
            [*command, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def __enter__(self):
        from websockets.sync.client import connect

        port_file = self.folder / "DevToolsActivePort"
        until(lambda: port_file.exists() and port_file.read_text().strip())
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            (tab,) = [tab for tab in json.load(answer) if tab["type"] == "page"]
        self._socket = connect(tab["webSocketDebuggerUrl"], max_size=None)
        self.call("Emulation.setDeviceMetricsOverride", **self._size, mobile=False)
        self.call("Network.enable")
        return self

    def __exit__(self, *_):
        self._socket.close()
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def call(self, method, **parameters):
        """Ask the browser, keeping what it says meanwhile in `events`."""
        self._number += 1
        asked = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(asked))
        while True:
            said = json.loads(self._socket.recv(timeout=120))
            if said.get("id") == self._number:
                assert "error" not in said, said
                return said["result"]
            self.events.append(said)

    def open(self, address):
        self.call("Page.navigate", url=address)

    def value(self, expression):
        """What JavaScript makes of an expression."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)[
            "result"
        ].get("value")

    def canvas_rgb(self):
        """What WebGL has drawn, None before it drew anything."""
        url = self.value(f"{CANVAS}?.toDataURL()")
        if not url or "," not in url:
            return None
        bgr = cv2.imdecode(np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8), 1)
        return None if bgr is None else bgr[..., ::-1].astype(np.float32) / 255

    def requested(self):
        """Addresses of everything that was asked for."""
        found = [event for event in self.events if event["method"] == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in found]
