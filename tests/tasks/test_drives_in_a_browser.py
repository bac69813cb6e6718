"""A real browser shows what our own renderer shows, live and from the disk, and asks nobody."""

import math
from dataclasses import replace

import pytest
import torch
from chromium import NO_WEBGL, Chromium, found_browser, until

from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.viewing.annotations import vertical_fov_rad
from lidarpainter_models.viewing.viewer import live_viewer
from tasks.views.drive import shown_drive, write_page

pytestmark = pytest.mark.slow
WIDTH_PX, HEIGHT_PX = 480, 270
LEAST_DB = 24.0
"""The client draws harmonics of degree 0 alone, and 8 bits of colour and opacity."""


@pytest.fixture(scope="module", autouse=True)
def _a_browser_is_here():
    found_browser()


RECORDED = ViewRequest(trajectory=parse_trajectory("recorded"))


@pytest.fixture(scope="module")
def drive(run, viewed):
    scenes = {"painted": run.final, "before painting": run.unpainted}
    return shown_drive(viewed, RECORDED, scenes)


@pytest.fixture(scope="module")
def page(viewed, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "drive.html"
    write_page(viewed, RECORDED, out)
    return out


def browser(folder, **changes):
    return Chromium(folder, width_px=WIDTH_PX, height_px=HEIGHT_PX, **changes)


def psnr(drive, camera, view, rgb):
    """Of a browser's image against our own renderer's in the same place."""
    height_px, width_px, _ = rgb.shape
    focal_px = height_px / 2 / math.tan(vertical_fov_rad(camera) / 2)
    own = replace(
        camera,
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=width_px / 2,
        cy_px=height_px / 2,
        width_px=width_px,
        height_px=height_px,
    )
    scene = drive.path.builder.scene
    expected = scene.render(own, view.timestamp_ns, camera_name=view.camera_name).rgb.clamp(0, 1)
    error = (torch.from_numpy(rgb.copy()) - expected).square().mean()
    return float(-10 * error.log10())


def test_live_viewer_shows_what_the_renderer_shows_wherever_the_panel_says(drive, tmp_path):
    with (
        live_viewer(drive, None, label="toy", port=0) as (viewer, address),
        browser(tmp_path) as chromium,
    ):
        chromium.open(address)
        for moment, seat in ((0, "recorded"), (3, "recorded"), (2, "aside")):
            viewer.controls.moment.value, viewer.controls.seat.value = moment, seat
            camera, view = viewer._seat, drive.path.views[moment]

            def agrees(camera=camera, view=view):
                rgb = chromium.canvas_rgb()
                return rgb is not None and psnr(drive, camera, view, rgb) >= LEAST_DB

            until(agrees)


def test_page_from_the_disk_plays_and_asks_nobody(page, drive, tmp_path):
    with browser(tmp_path) as chromium:
        chromium.open(page.as_uri())
        camera, view = drive.path.camera(0), drive.path.views[0]
        until(
            lambda: (
                (rgb := chromium.canvas_rgb()) is not None
                and psnr(drive, camera, view, rgb) >= LEAST_DB - 2
            )  # a title stands over it
        )
        elsewhere = [
            address
            for address in chromium.requested()
            if not address.startswith(("data:", "blob:", page.as_uri()))
        ]
        assert elsewhere == []
        assert chromium.value("document.title") == "LidarPainter: toy/street"


def test_policy_keeps_a_page_from_asking_anybody(page, tmp_path):
    with browser(tmp_path) as chromium:
        chromium.open(page.as_uri())
        until(lambda: chromium.value("document.readyState") == "complete")
        chromium.value("fetch('http://127.0.0.1:9/').catch(error => window.refused = `${error}`)")
        assert "TypeError" in until(lambda: chromium.value("window.refused"))
        chromium.value(
            "addEventListener('securitypolicyviolation', e => window.why = e.violatedDirective)"
        )
        chromium.value(
            "document.body.append(Object.assign(new Image, {src: 'http://127.0.0.1:9/'}))"
        )
        assert until(lambda: chromium.value("window.why")) == "img-src"


def test_page_says_that_it_needs_webgl_where_there_is_none(page, tmp_path):
    with browser(tmp_path, words=NO_WEBGL) as chromium:
        chromium.open(page.as_uri())
        shown = "document.body?.innerText.includes('needs WebGL 2')"
        assert until(lambda: chromium.value(shown))
