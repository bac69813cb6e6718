"""Words drawn into textures so that they can be read."""

import cv2
import numpy as np

FONT = cv2.FONT_HERSHEY_DUPLEX


def draw_text(
    image: np.ndarray,
    text: str,
    *,
    box: tuple[float, float, float, float],
    colour: tuple[float, ...],
    weight: float = 0.13,
) -> None:
    """Fit a line of text into a box (left, top, right, bottom in pixels), centred.

    Drawn at several times the size and shrunk, so that thin strokes stay smooth. The image, uint8
    or float32 (height, width, channels), is changed in place. The text touches either the sides of
    the box or its top and bottom. `weight` is the thickness of a stroke relative to the height of a
    capital.
    """
    left, top, right, bottom = (round(edge) for edge in box)
    left, top = max(left, 0), max(top, 0)
    right, bottom = min(right, image.shape[1]), min(bottom, image.shape[0])
    if right - left < 3 or bottom - top < 3:
        return
    mask = text_mask(text, width_px=right - left, height_px=bottom - top, weight=weight)
    area = image[top:bottom, left:right].astype(np.float32)
    mixed = area + mask[..., None] * (np.asarray(colour, np.float32) - area)
    if image.dtype == np.uint8:
        mixed = np.clip(np.rint(mixed), 0, 255)
    image[top:bottom, left:right] = mixed.astype(image.dtype)


def text_mask(text: str, *, width_px: int, height_px: int, weight: float = 0.13) -> np.ndarray:
    """Coverage (height, width) in 0..1 of a line of text that fills as much as it can."""
    capital = 96
    thickness = max(round(capital * weight), 1)
    scale = cv2.getFontScaleFromHeight(FONT, capital, thickness)
    (width, height), below = cv2.getTextSize(text, FONT, scale, thickness)
    margin = thickness + 8
    canvas = np.zeros((height + below + 2 * margin + 40, width + 2 * margin), np.uint8)
    place = (margin, margin + height + 20)
    cv2.putText(canvas, text, place, FONT, scale, 255, thickness, cv2.LINE_AA)
    rows, columns = np.flatnonzero(canvas.any(1)), np.flatnonzero(canvas.any(0))
    result = np.zeros((height_px, width_px), np.float32)
    if rows.size == 0:
        return result
    tight = canvas[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    shrink = min(width_px / tight.shape[1], height_px / tight.shape[0])
    size = max(int(tight.shape[1] * shrink), 1), max(int(tight.shape[0] * shrink), 1)
    method = cv2.INTER_AREA if shrink < 1 else cv2.INTER_LINEAR
    small = cv2.resize(tight, size, interpolation=method).astype(np.float32) / 255
    x, y = (width_px - size[0]) // 2, (height_px - size[1]) // 2
    result[y : y + size[1], x : x + size[0]] = small
    return result
