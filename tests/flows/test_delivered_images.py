"""What a protocol measures is what a command delivers, on the same pixels.

A second camera half a metre to the right of the fitted one stands where `render` follows
`lateral:-0.5`: what its image says of painting, the written files must say as well.
"""

import cv2
import pytest
import torch
from commands import settings, succeed
from tiny_street import FRONT, NUM_FRAMES, SETTINGS, tiny_street

from catalog.store import open_store
from lidarpainter_models.evaluation import strips
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.strips import strip_views
from lidarpainter_models.metrics.images import psnr_from_error, squared_error
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.synthetic import RigCamera
from tasks.ingest.ingest import ingest_street
from tasks.opened import open_scene
from tasks.runs import open_run
from tasks.stored import load_scene

ASIDE_M = 0.5
WIDTH_PX = 192
SECOND = "second_camera"
CAMERAS = (
    RigCamera(name=FRONT, focal_per_width=1.026),
    RigCamera(name=SECOND, focal_per_width=1.026, left_m=-ASIDE_M),
)
CHANGES = (f"observation.width_px={WIDTH_PX}", "rounds=0", "fit.steps=120")


@pytest.fixture(scope="module")
def stereo_run(prefect_api, tmp_path_factory):  # noqa: ARG001
    store = open_store(tmp_path_factory.mktemp("stereo") / "store")
    street = tiny_street(seed=6, width_px=WIDTH_PX, height_px=108, cameras=CAMERAS)
    ingest_street.fn(store.root, street)
    words = ("reconstruct", "synthetic/street-0006", "--json", *settings(*SETTINGS, *CHANGES))
    run_id = succeed(*words, store=store).json["run_id"]
    return store, run_id


def delivered_psnr(store, run_id, folder):
    """PSNR of written images on the strips that the protocol judges."""
    finished = open_run(store, run_id)
    scene = open_scene(store, finished.scene_id)
    odd = tuple(range(1, NUM_FRAMES, 2))
    views = strip_views(
        HeldOut(scene=scene, test_views=[], observation=ObservationConfig(width_px=WIDTH_PX)),
        load_scene(store, finished.final.gaussians),
        judging_camera=SECOND,
        fitted_camera=FRONT,
        frames=odd,
    )
    wrong = []
    for frame, view in zip(odd, views, strict=True):
        written = cv2.cvtColor(cv2.imread(str(folder / f"{frame:04d}.png")), cv2.COLOR_BGR2RGB)
        image = torch.from_numpy(written).float() / 255
        wrong.append(squared_error(image, view.truth_rgb)[strips.strip_mask(view)].double())
    return psnr_from_error(float(torch.cat(wrong).mean()))


@pytest.mark.slow
def test_gain_of_painting_is_that_of_the_delivered_files(stereo_run, tmp_path):
    store, run_id = stereo_run
    words = ("evaluate", run_id, "--protocol", "cross-camera", "--postpaint", "--json")
    judged = succeed(*words, store=store).json
    painted, plain = judged["view-time"][SECOND], judged["unpainted"][SECOND]
    succeed(
        *("render", run_id, "--trajectory", f"lateral:{-ASIDE_M}", "--camera", FRONT),
        *("--postpaint", "--out", tmp_path),
        store=store,
    )
    delivered = {
        "painted": delivered_psnr(store, run_id, tmp_path),
        "plain": delivered_psnr(store, run_id, tmp_path / "unpainted"),
    }
    gain_db = delivered["painted"] - delivered["plain"]
    assert painted["uncalibrated_psnr"] == pytest.approx(delivered["painted"], abs=0.05)
    assert plain["uncalibrated_psnr"] == pytest.approx(delivered["plain"], abs=0.05)
    assert painted["uncalibrated_psnr"] - plain["uncalibrated_psnr"] == pytest.approx(
        gain_db, abs=0.05
    )
    assert painted["psnr"] - plain["psnr"] == pytest.approx(gain_db, abs=0.3)  # calibrated
