"""Judge served images of every kind of lens against exact ones of a street, on the same directions.

    python scripts/judge_lenses.py FOLDER [--seed 411] [--preset brief]

A street is written into FOLDER and fitted; its held-out frames are served through each lens at one
size and compared with what stands in the direction of each pixel, the mean over 4 x 4 rays in it.
Lenses have more or fewer pixels to an angle, and coarse pixels hide errors: so images are also
compared on one grid of directions, which all of the lenses see, its cells as wide as the pixels of
the coarsest lens. Cells count by their solid angle.
"""

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

import lidarpainter_models as lp
from flows.presets import preset
from lidarpainter_models.evaluation.anchoring import calibration_of
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.serving.image_formats import Encoding
from lidarpainter_models.serving.lens_models import (
    PinholeLens,
    RadialLens,
    RisingCurve,
    SensorCamera,
)
from lidarpainter_models.serving.messages import SensorRequest
from lidarpainter_models.serving.renderer import ServedScene
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

WIDTH_PX, HEIGHT_PX, NUM_FRAMES = 320, 180, 12
RAYS, SAMPLES = 4, 4
"""Rays along a pixel of a true image; places along a cell of the grid."""
TRUE_FACE_PX = 1600
"""Side of each face of the cube of true pinhole images: finer than the rays of every lens."""
RIM = 0.04
"""Of the pinhole's image: a lens that is a little narrower sees the grid too."""
Image = np.ndarray


def lenses(pinhole: Camera) -> dict[str, SensorCamera]:
    """A lens of each kind before images of one size, by name."""
    plain = SensorCamera.of_pinhole(pinhole)
    half_rad = math.radians(95)
    fisheye = RadialLens(RisingCurve((0.0, 1.0, 0.0, -0.02), half_rad), True, half_rad)
    focal_px = WIDTH_PX / 2 / float(fisheye.curve.at(torch.tensor(half_rad).double()))
    ftheta_px = pinhole.fx_px * 0.95
    ftheta = RadialLens(RisingCurve((0.0, ftheta_px, 0.0, 0.1 * ftheta_px), 1.2), True, 1.2)
    rational = PinholeLens((-0.12, 0.03, -0.004, 0.02), (0.001, -0.001), (0.0005, 0.0, -0.0005))
    return {
        "pinhole": plain,
        "rational": replace(plain, lens=rational),
        "f-theta": replace(plain, lens=ftheta, pixels_per_unit=(1.0, 0.0, 0.0, 1.0)),
        "fisheye of 190 degrees": replace(
            plain, lens=fisheye, pixels_per_unit=(focal_px, 0.0, 0.0, focal_px)
        ),
    }


def true_colours(
    street: SyntheticStreet, world_from_camera: torch.Tensor, timestamp_ns: int
) -> Callable[[Image], Image]:
    """The true colours in directions of the camera's frame, looked up on six faces of a cube."""
    turns = []
    for axis, sign in ((2, 1), (2, -1), (0, 1), (0, -1), (1, 1), (1, -1)):
        ahead, down = sign * np.eye(3)[axis], np.eye(3)[1 if axis != 1 else 2]
        turns.append(np.stack([np.cross(down, ahead), down, ahead], axis=1))
    faces: dict[int, Image] = {}

    def face(number: int) -> Image:
        if number not in faces:
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = torch.from_numpy(turns[number])
            side = {"width_px": TRUE_FACE_PX, "height_px": TRUE_FACE_PX}
            camera = Camera.centred(world_from_camera @ pose, TRUE_FACE_PX / 2, **side)
            faces[number] = street.render(camera, timestamp_ns).rgb.numpy()
        return faces[number]

    def colours(rays: Image) -> Image:
        nearest = np.stack([rays @ turn[:, 2] for turn in turns]).argmax(axis=0)
        found = np.empty((*rays.shape[:-1], 3), np.float32)
        for number in np.unique(nearest).tolist():
            rows = np.nonzero(nearest == number)
            seen = rays[rows] @ turns[number]
            at = (seen[:, :2] / seen[:, 2:] + 1) * (TRUE_FACE_PX / 2)
            column, row = np.clip(at.astype(int), 0, TRUE_FACE_PX - 1).T
            found[rows] = face(number)[row, column]
        return found

    return colours


def true_image(camera: SensorCamera, colours: Callable[[Image], Image]) -> Image:
    """What the pixels of a lens truly show: the mean over rays in each."""
    finer = camera.resized(RAYS * camera.width_px, RAYS * camera.height_px)
    rays, _ = finer.pixel_rays()
    size = (camera.width_px, camera.height_px)
    return cv2.resize(colours(rays.numpy()), size, interpolation=cv2.INTER_AREA)


def grid_of(pinhole: Camera, cell_px: float) -> tuple[Image, Image]:
    """Directions of the samples of a grid over the pinhole's image, and solid angles of cells."""
    low = RIM * np.array([WIDTH_PX, HEIGHT_PX])
    cells = ((np.array([WIDTH_PX, HEIGHT_PX]) - 2 * low) / cell_px).astype(int)
    across, down = (
        low[axis] + (np.arange(SAMPLES * cells[axis]) + 0.5) * cell_px / SAMPLES for axis in (0, 1)
    )
    x = (across[None] - pinhole.cx_px) / pinhole.fx_px + 0 * down[:, None]
    y = (down[:, None] - pinhole.cy_px) / pinhole.fy_px + 0 * across[None]
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    solid = cv2.resize((x * x + y * y + 1) ** -1.5, cells.tolist(), interpolation=cv2.INTER_AREA)
    return rays, solid


def on_grid(image: Image, camera: SensorCamera, rays: Image) -> Image:
    """An image of a lens on the cells of a grid of directions."""
    place = camera.project(torch.from_numpy(rays)).numpy().astype(np.float32) - np.float32(0.5)
    across, down = place[..., 0], place[..., 1]
    seen = cv2.remap(image, across, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    size = (rays.shape[1] // SAMPLES, rays.shape[0] // SAMPLES)
    return cv2.resize(seen, size, interpolation=cv2.INTER_AREA)


def served_street(folder: Path, seed: int, name: str) -> tuple[SyntheticStreet, ServedScene, list]:
    """A street, its scene, and the views that the fit did not see."""
    config = SyntheticStreetConfig(
        seed=seed,
        num_frames=NUM_FRAMES,
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        cameras=DEFAULT_CAMERAS[:1],
    )
    recording = DrivingScene.open(write_street(config, folder))
    split = lp.split_views(recording, "alternate", None)
    size = lp.ObservationConfig(width_px=WIDTH_PX)
    seen = lp.prepare_observations(recording, split, size)
    scene = lp.fit_gaussians(seen, preset(name, "judged").fit).scene
    builder = lp.ConditionBuilder(scene, seen.lidar_map, seen.views)
    served = ServedScene(
        scene_id="street",
        recorded=recording,
        builder=builder,
        observation=size,
        calibration=calibration_of(None),
        is_measured=False,
    )
    fitted = {view.key for view in seen.views}
    held_out = [view for view in recording.views if view.key not in fitted]
    single = replace(config, samples_per_axis=1)  # true images are looked up between its pixels
    return SyntheticStreet(single), served, held_out[1::2]


def shown_image(served: ServedScene, camera: SensorCamera, view, pose: torch.Tensor) -> Image:  # noqa: ANN001
    """What the server shows through a lens where the camera of a view truly was."""
    time_ns = view.timestamp_ns
    poses, present = served.scene.actors.refined_poses(time_ns)
    rows = present.nonzero()[:, 0].tolist()
    tracks = served.scene.actors.recorded_tracks
    request = SensorRequest(
        scene_id="street",
        start_us=time_ns // 1000,
        end_us=time_ns // 1000,
        world_from_sensor=pose.expand(2, 4, 4),
        actor_ids=tuple(tracks[row].actor_id for row in rows),
        world_from_actors=poses[rows][:, None].expand(-1, 2, 4, 4),
        camera_name=view.camera_name,
        camera=camera,
        encoding=Encoding(),
    )
    return served.frame(request).rgb_u8.astype(np.float32) / 255


def psnr(squares: list[float]) -> float:
    """In dB, over all frames."""
    return -10 * math.log10(float(np.mean(squares)))


def main(folder: Path, seed: int, name: str) -> None:
    """Print a line for every lens."""
    street, served, views = served_street(folder, seed, name)
    pinhole = street.camera(views[0].camera_name, views[0].timestamp_ns)
    found = lenses(pinhole)
    cell_px = pinhole.fx_px / min(_pixels_per_rad(camera) for camera in found.values())
    rays, solid = grid_of(pinhole, cell_px)
    errors: dict[str, tuple[list[float], list[float]]] = {one: ([], []) for one in found}
    for view in views:
        pose = served.found(view).world_from_camera.double()
        truth = street.camera(view.camera_name, view.timestamp_ns).world_from_camera
        colours = true_colours(street, truth, view.timestamp_ns)
        for lens, camera in found.items():
            shown, exact = shown_image(served, camera, view, pose), true_image(camera, colours)
            is_seen = served.lens(camera).is_seen.numpy()
            own, common = errors[lens]
            own.append(float(np.square(shown - exact)[is_seen].mean()))
            apart = on_grid(shown, camera, rays) - on_grid(exact, camera, rays)
            common.append(float((np.square(apart).mean(axis=2) * solid).sum() / solid.sum()))
    sys.stdout.write(
        f"street {seed}, {name}, {len(views)} held-out frames, {WIDTH_PX} x {HEIGHT_PX} px; the "
        f"grid has {solid.shape[1]} x {solid.shape[0]} cells\n"
    )
    reference = psnr(errors["pinhole"][1])
    for lens, (own, common) in errors.items():
        sys.stdout.write(
            f"{lens}: {_pixels_per_rad(found[lens]):.0f} px/rad, own pixels {psnr(own):.2f} dB, "
            f"same directions {psnr(common):.2f} dB ({psnr(common) - reference:+.2f})\n"
        )


def _pixels_per_rad(camera: SensorCamera) -> float:
    """In the middle of the image."""
    near = torch.tensor([[0.0, 0.0, 1.0], [1e-4, 0.0, 1.0]], dtype=torch.float64)
    return float(camera.project(near).diff(dim=0).norm()) / 1e-4


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=411)
    parser.add_argument("--preset", default="brief")
    given = parser.parse_args()
    main(given.folder, given.seed, given.preset)
