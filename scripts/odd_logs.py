"""Odd boxes, images and lenses of a log, as changes of its frames; `fuzz_logs.py` combines them."""

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from lidarpainter_models.scenes.records import BoxRecord, Distortion
from lidarpainter_models.stress.frames import Frame, Shot

Change = Callable[[Frame], Frame]


# --- boxes


def _with_boxes(change: Callable[[Frame, BoxRecord], list[BoxRecord]]) -> Change:
    """Each box becomes those that a function makes of it."""
    return lambda frame: replace(
        frame, boxes=tuple(new for box in frame.boxes for new in change(frame, box))
    )


def _own_box(size_m: tuple[float, float, float]) -> Change:
    """The recording car among the actors, as CARLA lists it."""

    def added(frame: Frame) -> Frame:
        place = frame.world_from_ego.clone()
        place[:3, 3] += 0.5 * size_m[2] * place[:3, 2] + 0.5 * place[:3, 0]
        box = BoxRecord(
            actor_id="ego",
            category="vehicle.car",
            timestamp_ns=frame.timestamp_ns,
            world_from_box=place,
            size_m=size_m,
            is_moving=True,
            num_points=0,
        )
        return replace(frame, boxes=(*frame.boxes, box))

    return added


def _moved(frame: Frame, box: BoxRecord, forward_m: float) -> BoxRecord:
    place = box.world_from_box.clone()
    place[:3, 3] += forward_m * frame.world_from_ego[:3, 0]
    return replace(box, world_from_box=place)


def _turned(box: BoxRecord, turn: Sequence[Sequence[float]]) -> BoxRecord:
    place = box.world_from_box.clone()
    place[:3, :3] = place[:3, :3] @ torch.tensor(turn, dtype=place.dtype)
    return replace(box, world_from_box=place)


def _spoilt(box: BoxRecord, value: float) -> BoxRecord:
    place = box.world_from_box.clone()
    place[0, 3] = value
    return replace(box, world_from_box=place)


BOXES: dict[str, Change] = {
    "plain": lambda frame: frame,
    "own-car": _own_box((4.8, 2.0, 1.7)),
    "own-car-large": _own_box((7.0, 3.0, 2.6)),
    "none": _with_boxes(lambda _frame, _box: []),
    "twice": _with_boxes(lambda _frame, box: [box, box]),
    "same-time": _with_boxes(
        lambda frame, box: [replace(box, timestamp_ns=frame.timestamp_ns - frame.position % 2)]
    ),
    "time-stands": _with_boxes(
        lambda _frame, box: [replace(box, timestamp_ns=box.timestamp_ns // 10**9 * 10**9)]
    ),
    "away-and-back": _with_boxes(lambda frame, box: [] if 3 <= frame.position <= 6 else [box]),
    "new-ids": _with_boxes(
        lambda frame, box: [replace(box, actor_id=f"{box.actor_id}-{frame.frame_index}")]
    ),
    "one-id": _with_boxes(lambda _frame, box: [replace(box, actor_id="one")]),
    "odd-names": _with_boxes(
        lambda _frame, box: [
            replace(box, actor_id=f"../{box.actor_id}\n%2Fé", category="Fahrzeug/Pkw é")
        ]
    ),
    "flat": _with_boxes(lambda _frame, box: [replace(box, size_m=(*box.size_m[:2], 0.0))]),
    "huge": _with_boxes(lambda _frame, box: [replace(box, size_m=(90.0, 60.0, 30.0))]),
    "negative": _with_boxes(lambda _frame, box: [replace(box, size_m=(-4.0, 2.0, 1.5))]),
    "not-a-number": _with_boxes(lambda _frame, box: [_spoilt(box, math.nan)]),
    "endless": _with_boxes(lambda _frame, box: [_spoilt(box, math.inf)]),
    "far": _with_boxes(lambda frame, box: [_moved(frame, box, 1e7)]),
    "beside": _with_boxes(lambda frame, box: [_moved(frame, box, 4.0)]),
    "backwards": _with_boxes(
        lambda _frame, box: [_turned(box, ((-1, 0, 0), (0, -1, 0), (0, 0, 1)))]
    ),
    "mirrored": _with_boxes(lambda _frame, box: [_turned(box, ((1, 0, 0), (0, -1, 0), (0, 0, 1)))]),
    "all-stand": _with_boxes(lambda _frame, box: [replace(box, is_moving=False)]),
    "all-move": _with_boxes(lambda _frame, box: [replace(box, is_moving=True)]),
}
"""Odd boxes by name."""


# --- images


def _with_images(change: Callable[[np.ndarray, Frame], np.ndarray]) -> Change:
    """Pixels of each image changed in place or anew."""
    return lambda frame: replace(
        frame,
        images=tuple(shot.with_pixels(lambda bgr: change(bgr, frame)) for shot in frame.images),
    )


def _covered(colour: float, low: float, left: float, right: float) -> Change:
    """Something that stays in place from `low` (share of the height) down, between two sides."""

    def cover(bgr: np.ndarray, _frame: Frame) -> np.ndarray:
        height, width = bgr.shape[:2]
        bgr[int(low * height) :, int(left * width) : int(right * width)] = colour
        return bgr

    return _with_images(cover)


def _framed(bgr: np.ndarray, _frame: Frame) -> np.ndarray:
    bgr[:4] = bgr[-4:] = bgr[:, :4] = bgr[:, -4:] = 0
    return bgr


IMAGES: dict[str, Change] = {
    "plain": lambda frame: frame,
    "bonnet-dark": _covered(20, 0.78, 0.0, 1.0),
    "bonnet-bright": _covered(200, 0.8, 0.0, 1.0),
    "mirror": _covered(15, 0.55, 0.0, 0.25),
    "black-border": _with_images(_framed),
    "black": _with_images(lambda bgr, _frame: 0 * bgr),
    "white": _with_images(lambda bgr, _frame: 0 * bgr + 255),
    "one-black": _with_images(lambda bgr, frame: bgr * (frame.position != 4)),
    "grey": _with_images(lambda bgr, _frame: bgr.mean(axis=2, keepdims=True).repeat(3, axis=2)),
    "upside-down": _with_images(lambda bgr, _frame: bgr[::-1, ::-1]),
}
"""Odd images by name."""
LOOKED_FOR_BY = {
    "bonnet-dark": "own body",
    "bonnet-bright": "own body",
    "mirror": "own body",
    "upside-down": "cameras in their place",
}
"""The check that looks for an odd image: a loss is named also where it says it could not look."""


# --- lenses


def lens_as_it_is(frame: Frame) -> Frame:
    """The pinhole of the street."""
    return frame


def random_lens(dice: random.Random) -> Change:
    """A lens of any model and any strength, and the images as it would have taken them."""
    model = dice.choice(("brown", "fisheye", "mei"))
    strength = 10 ** dice.uniform(-3, 0.5)
    terms = [dice.gauss(0, strength) * 0.3**place for place in range(4)]
    if model == "brown":
        terms[2:] = [0.01 * term for term in terms[2:]]
    if model == "mei":
        terms = [dice.uniform(0.2, 2.2), *terms[:2], 0.001 * terms[2], 0.001 * terms[3]]
    zoom = dice.choice((0.2, 0.5, 0.8, 1.0, 1.3)) * (1 + terms[0] if model == "mei" else 1)
    distortion = Distortion(model, tuple(terms))
    return lambda frame: replace(
        frame, images=tuple(_through(shot, distortion, zoom) for shot in frame.images)
    )


def _through(shot: Shot, distortion: Distortion, zoom: float) -> Shot:
    pinhole = shot.record.camera
    lens = replace(pinhole, fx_px=zoom * pinhole.fx_px, fy_px=zoom * pinhole.fy_px)
    matrix = np.array(
        [[lens.fx_px, 0, lens.cx_px - 0.5], [0, lens.fy_px, lens.cy_px - 0.5], [0, 0, 1.0]]
    )
    grid = np.indices((lens.height_px, lens.width_px)).transpose(1, 2, 0)[..., ::-1]
    pixels, terms = grid.reshape(-1, 1, 2).astype(np.float64), np.array(distortion.terms)
    if distortion.model == "brown":
        rays = cv2.undistortPoints(pixels, matrix, terms)
    elif distortion.model == "fisheye":
        rays = cv2.fisheye.undistortPoints(pixels, matrix, terms)
    else:
        rays = cv2.omnidir.undistortPoints(pixels, matrix, terms[1:], terms[:1], np.eye(3))
    scale = np.array([pinhole.fx_px, pinhole.fy_px])
    centre = np.array([pinhole.cx_px - 0.5, pinhole.cy_px - 0.5])
    places = (np.nan_to_num(rays) * scale + centre).clip(-1e4, 1e4).astype(np.float32)
    places = places.reshape(lens.height_px, lens.width_px, 2)
    seen = shot.with_pixels(
        lambda bgr: cv2.remap(
            bgr, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    )
    return replace(seen, record=replace(seen.record, camera=lens, distortion=distortion))
