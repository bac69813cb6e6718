"""What neurad-studio's protocol judges: all of every held-out image, but for one camera's rows."""

import pytest
import torch
from gaussian_world import scene_trained_on
from stub_inception import MeansAsFeatures
from toy_street import ToyStreet

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.neurad_protocol import neurad_scores
from lidarpainter_models.evaluation.score_tables import NEURAD, metric_values
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.geometry.trajectories import road_directions
from lidarpainter_models.metrics.images import psnr_from_error
from lidarpainter_models.metrics.perceptual import PerceptualDistances
from lidarpainter_models.observations.settings import ObservationConfig

CAMERAS = (("front_camera", 1.0), ("back_camera", 1.0))
WIDTH_PX = 64
WRONG = 0.5
"""How far images are off where they are off."""


@pytest.fixture
def held_out():
    street = ToyStreet(num_frames=4, camera_gains=CAMERAS)
    street.dataset = "pandaset"
    tests = tuple(view for view in street.views if view.frame_index % 2)
    return HeldOut(scene=street, test_views=tests, observation=ObservationConfig(width_px=WIDTH_PX))


def scores(held_out, wrong_rows, distances=None, seen=None):
    """Of images that are exact but for so many rows at the bottom; `seen` takes the cameras."""
    views = held_out.scene.views
    fitted = scene_trained_on([view for view in views if view.frame_index % 2 == 0])
    truths = {
        (view.camera_name, view.timestamp_ns): held_out.image_of(view)
        for view in held_out.test_views
    }

    class Shown(ShownScene):
        def renderer(self, camera_name):
            def render(camera, timestamp_ns):
                if seen is not None:
                    seen.append((camera, timestamp_ns))
                image = truths[camera_name, timestamp_ns].clone()
                bottom = image[len(image) - wrong_rows :]
                bottom += torch.where(bottom > WRONG, -WRONG, WRONG)
                return image

            return render

    return neurad_scores(held_out, Shown(scene=fitted), distances or PerceptualDistances(), told)


def told(_done, _total):
    pass


def test_every_pixel_counts_but_the_rows_cut_off_the_back_camera(held_out):
    height_px = held_out.image_of(held_out.test_views[0]).shape[0]
    cut = height_px - round(height_px * (1 - 260 / 1080))
    found = scores(held_out, wrong_rows=cut)[NEURAD]
    assert found["front_camera"]["psnr"] == pytest.approx(
        psnr_from_error(WRONG**2 * cut / height_px), abs=1e-3
    )
    assert found["back_camera"]["psnr"] > 90
    assert scores(held_out, wrong_rows=cut + 1)[NEURAD]["back_camera"]["psnr"] < 30


def test_every_image_of_every_camera_has_the_same_weight(held_out):
    held_out = HeldOut(
        scene=held_out.scene,
        test_views=held_out.test_views[:3],  # two of the front camera
        observation=held_out.observation,
    )
    found = scores(held_out, wrong_rows=20)[NEURAD]
    front, back, everything = (found[name] for name in ("front_camera", "back_camera", "all"))
    assert everything["num_views"] == 3
    assert everything["ssim"] == pytest.approx((2 * front["ssim"] + back["ssim"]) / 3)
    assert everything["num_columns"] == WIDTH_PX


def test_what_is_absent_says_why(held_out):
    rows = metric_values(scores(held_out, wrong_rows=1))
    reasons = {
        (protocol, camera, name): reason
        for protocol, camera, name, value, reason in rows
        if value is None
    }
    assert "Inception" in reasons[NEURAD, "all", "fid"]
    assert "Inception" in reasons[NEURAD, "right-3m", "kid"]
    assert reasons[NEURAD, "all", "lpips"]


def test_fid_compares_what_is_left_of_images_at_every_shift(held_out):
    """What is cut off counts in no set; images of the toy street are the same wherever it is."""
    height_px = held_out.image_of(held_out.test_views[0]).shape[0]
    cut = height_px - round(height_px * (1 - 260 / 1080))
    back = HeldOut(
        scene=held_out.scene,
        test_views=[view for view in held_out.test_views if view.camera_name == "back_camera"],
        observation=held_out.observation,
    )
    network = PerceptualDistances(inception=MeansAsFeatures())
    seen = []
    exact = scores(back, wrong_rows=cut, distances=network, seen=seen)[NEURAD]
    wrong = scores(back, wrong_rows=cut + 4, distances=network)[NEURAD]
    for name in ("all", "left-2m", "right-2m", "left-3m", "right-3m", "up-1m"):
        assert exact[name]["fid"] == pytest.approx(0, abs=1e-9)
        assert wrong[name]["fid"] > 1e-4
        assert (exact[name]["num_real"], exact[name]["num_shown"]) == (2, 2)
    recorded = {view.timestamp_ns: view.camera for view in back.test_views}
    ahead = road_directions(held_out.scene.world_from_ego)[0]
    left = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), ahead)
    moves = [camera.centre_world - recorded[time].centre_world for camera, time in seen]
    sides = [round(float(move @ left / left.norm()), 2) for move in moves]
    # each of the two views as it is judged, then at every shift
    assert sides == [0, 0, 0, 0, 2, 2, -2, -2, 3, 3, -3, -3, 0, 0]
    assert [round(float(move[2]), 2) for move in moves] == [0] * 12 + [1, 1]
