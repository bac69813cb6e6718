"""The recording car in its own images: found where it is, and nowhere else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from toy_street import LOOK_FORWARD, ToyStreet

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_scores import score_views
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import rigid_from_rotation
from lidarpainter_models.metrics.lpips_files import LpipsFiles
from lidarpainter_models.metrics.perceptual import load_distances
from lidarpainter_models.observations.own_body import (
    behind_traffic,
    cannot_be_told,
    in_words,
    on_grid,
    own_bodies,
)
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.observations.stored_form import (
    observations_from_arrays,
    observations_to_arrays,
)
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.splits import split_views

WIDTH_PX, HEIGHT_PX = 320, 180
SIDEWAYS = LOOK_FORWARD @ torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def bonnet():
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    cv2.ellipse(mask, (160, 190), (200, 50), 0, 0, 360, 1, -1)
    return mask > 0


def mirror():
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    cv2.ellipse(mask, (0, 150), (60, 30), 0, 0, 360, 1, -1)
    return mask > 0


def car_ahead():
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
    mask[105:140, 130:190] = True
    return mask


class RoadDrive(ToyStreet):
    """A car on a plain of random patches; what of its images is the car itself shines a little."""

    def __init__(
        self, body, *, step_m=0.6, looks=LOOK_FORWARD, num_frames=12, is_night=False, lamps=0
    ):
        super().__init__(num_frames)
        self.is_night, self.lamps = is_night, lamps
        self.body, self.tracks = body, ()
        place = np.random.default_rng(0)
        self.patches = cv2.GaussianBlur(
            place.uniform(0, 255, (512, 512)).astype(np.float32), (0, 0), 1
        )
        self.patches = np.clip(self.patches - 10, 80, 160)
        self.views = tuple(
            RecordedView(
                frame_index=frame,
                camera_name="front",
                timestamp_ns=frame * 100_000_000,
                camera=Camera.centred(
                    rigid_from_rotation(looks, torch.tensor([step_m * frame, 0.0, 1.7])).double(),
                    200,
                    width_px=WIDTH_PX,
                    height_px=HEIGHT_PX,
                ),
                index=0,
            )
            for frame in range(num_frames)
        )

    def read_image(self, view):
        pose = view.camera.world_from_camera
        rays = (view.camera.pixel_directions().double() @ pose[:3, :3].T).numpy()
        away = 1.7 / np.maximum(-rays[..., 2], 1e-3)
        ground = pose[:2, 3].numpy() + away[..., None] * rays[..., :2]
        column, row = (np.floor(ground * 4).astype(int) % 512).transpose(2, 0, 1)
        image = np.where(rays[..., 2] < 0, self.patches[row, column], 210)
        if self.body is not None:
            shine = 20 * np.sin(np.arange(WIDTH_PX) / 25 + view.frame_index)
            lit = self.lamps * (view.frame_index % 2)  # brighter than the road under each lamp
            image = np.where(self.body, 40 + shine + lit, image)
        if self.is_night:
            row, column = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
            lamp = np.exp(-(((column - 160) / 110) ** 4) - ((row - 130) / 60) ** 4)
            noise = np.random.default_rng(view.frame_index).normal(0, 3, image.shape)
            image = np.clip(0.5 * lamp * image + 12 + noise, 0, 255)
        return torch.from_numpy(np.repeat(image[..., None], 3, axis=2).astype(np.uint8))


@pytest.mark.parametrize(
    ("body", "options"),
    [
        (bonnet, {}),
        (mirror, {"looks": SIDEWAYS}),
        (bonnet, {"lamps": 200}),
        (bonnet, {"num_frames": 3, "step_m": 5.0}),
        (bonnet, {"is_night": True}),
    ],
    ids=["bonnet", "mirror", "lit by lamps", "three images", "night"],
)
def test_the_car_is_found_where_it_is(body, options):
    street = RoadDrive(body(), **options)
    (found,) = own_bodies(street, street.views).values()
    found = on_grid(found, width_px=WIDTH_PX, height_px=HEIGHT_PX).numpy()
    assert (found & body()).sum() / (found | body()).sum() > 0.8
    assert cannot_be_told(street.views) == {}


class InterruptedDrive(RoadDrive):
    """The edge of the bonnet is washed out in its middle, as where a car drives ahead."""

    def read_image(self, view):
        image = super().read_image(view).numpy()
        middle = np.s_[:, 145:175]
        image[middle] = cv2.GaussianBlur(image, (0, 0), 40)[middle]
        return torch.from_numpy(image)


def test_one_edge_across_the_image_may_be_interrupted():
    street = InterruptedDrive(bonnet())
    (found,) = own_bodies(street, street.views).values()
    found = on_grid(found, width_px=WIDTH_PX, height_px=HEIGHT_PX).numpy()
    assert (found & bonnet()).sum() / (found | bonnet()).sum() > 0.8


def test_what_cars_alongside_hide_is_said():
    street = RoadDrive(mirror(), looks=LOOK_FORWARD)
    assert behind_traffic(street, street.views) == {}
    track = ToyStreet(len(street.views)).tracks[0]
    beside = [
        rigid_from_rotation(torch.eye(3), torch.tensor([0.6 * frame + 6, 2.0, 1.0])).double()
        for frame in range(len(street.views))
    ]
    street.tracks = (replace(track, world_from_box=torch.stack(beside)),)
    (share,) = behind_traffic(street, street.views).values()
    assert 0.05 < share < 0.5


class BinnedDrive(RoadDrive):
    """A camera that bins its pixels from the middle of the drive on."""

    def read_image(self, view):
        if view.camera.width_px == WIDTH_PX:
            return super().read_image(view)
        whole = view.camera.resized(width_px=WIDTH_PX, height_px=HEIGHT_PX)
        image = super().read_image(replace(view, camera=whole)).numpy()
        return torch.from_numpy(cv2.resize(image, None, fx=0.5, fy=0.5))


def test_images_of_one_camera_may_differ_in_size():
    street = BinnedDrive(bonnet())
    small = {"width_px": WIDTH_PX // 2, "height_px": HEIGHT_PX // 2}
    views = [
        replace(view, camera=view.camera.resized(**small)) if view.frame_index > 5 else view
        for view in street.views
    ]
    (found,) = own_bodies(street, views).values()
    found = on_grid(found, width_px=WIDTH_PX, height_px=HEIGHT_PX).numpy()
    assert (found & bonnet()).sum() / (found | bonnet()).sum() > 0.75


@pytest.mark.parametrize(
    ("body", "options"),
    [
        (None, {}),
        (None, {"is_night": True}),
        (None, {"num_frames": 3, "step_m": 5.0}),
        (bonnet, {"step_m": 0.0}),
        (car_ahead, {}),
    ],
    ids=["no body", "no body at night", "three images", "a car that stands", "a car ahead"],
)
def test_what_is_no_part_of_the_car_stays(body, options):
    street = RoadDrive(body and body(), **options)
    assert own_bodies(street, street.views) == {}


def test_a_camera_with_too_few_images_taken_apart_cannot_be_told():
    standing = RoadDrive(bonnet(), step_m=0.0)
    assert cannot_be_told(standing.views) == {"front": "1 images taken apart, 3 needed"}
    two = RoadDrive(bonnet(), num_frames=2)
    assert cannot_be_told(two.views) == {"front": "2 images taken apart, 3 needed"}


def test_a_camera_whose_street_hardly_moves_cannot_be_told():
    coarse = [
        replace(view, camera=view.camera.resized(width_px=48, height_px=27))
        for view in RoadDrive(bonnet(), num_frames=4).views
    ]
    assert "48 px wide" in cannot_be_told(coarse)["front"]


def test_a_wide_lens_whose_images_are_coarse_cannot_be_told():
    wide = [
        replace(view, camera=replace(view.camera, fx_px=100.0, fy_px=100.0))
        for view in RoadDrive(None).views
    ]
    assert "1.7 pixels a degree, 2.2 are needed" in cannot_be_told(wide)["front"]


@pytest.fixture(scope="module")
def prepared():
    street = RoadDrive(bonnet())
    return prepare_observations(street, split_views(street, "all"), ObservationConfig(width_px=160))


def test_its_pixels_are_hidden_and_colour_no_point(prepared):
    (body,) = prepared.own_bodies.values()
    assert tuple(body.shape) == (90, 160)
    assert all(torch.equal(view.hidden, body) for view in prepared.views)
    shown = prepared.views[0]
    assert not bool((shown.shows_surface & body).any())
    assert in_words("front", body).startswith("front shows the recording car in ")


def test_they_are_stored_once(prepared):
    arrays, metadata = observations_to_arrays(prepared)
    assert [name for name in arrays if "hidden" in name or "own_body" in name] == ["own_body.front"]
    again = observations_from_arrays(arrays, metadata)
    assert all(torch.equal(view.hidden, prepared.views[0].hidden) for view in again.views)


def test_a_fit_learns_nothing_from_them_and_is_not_judged_there(prepared):
    street, config = RoadDrive(bonnet()), FitConfig(steps=80)
    fitted = fit_gaussians(prepared, config).scene
    body = prepared.own_bodies["front"]
    held_out = HeldOut(
        scene=street, test_views=street.views[5:6], observation=ObservationConfig(width_px=160)
    )
    (judged,) = held_out.recorded_views(fitted, "interpolated")
    shown = fitted.render(judged.camera, judged.timestamp_ns).rgb.detach()
    assert float(shown[body].mean()) > 0.3  # the road, not the dark bonnet
    scores = score_views(
        lambda _camera, _time: torch.where(body[..., None], 1.0, judged.truth_rgb),
        [judged],
        distances=load_distances(None, LpipsFiles()),
    )
    assert scores.psnr == float("inf")
    assert scores.ssim == pytest.approx(1.0)
