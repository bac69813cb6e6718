"""Put images of one size side by side, row by row, into one JPEG.

`python scripts/picture_sheet.py sheet.jpg 3 a.png b.png c.png d.png e.png f.png` makes two rows
of three.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

GAP_PX = 4
QUALITY = 88


def sheet(images: list[np.ndarray], num_columns: int) -> np.ndarray:
    """The images on white, with gaps between."""
    height, width, _ = images[0].shape
    num_rows = -(-len(images) // num_columns)
    canvas = np.full(
        (
            num_rows * (height + GAP_PX) - GAP_PX,
            num_columns * (width + GAP_PX) - GAP_PX,
            3,
        ),
        255,
        np.uint8,
    )
    for index, image in enumerate(images):
        row, column = divmod(index, num_columns)
        top, left = row * (height + GAP_PX), column * (width + GAP_PX)
        canvas[top : top + height, left : left + width] = image
    return canvas


def main(out: Path, num_columns: int, paths: list[Path]) -> None:
    """Read, arrange, write."""
    images: list[np.ndarray] = []
    for path in paths:
        image = cv2.imread(str(path))
        if image is None or (images and image.shape != images[0].shape):
            sys.exit(f"{path}: expected an image of the size of {paths[0]}")
        images.append(image)
    cv2.imwrite(str(out), sheet(images, num_columns), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit("usage: picture_sheet.py OUT.jpg COLUMNS IMAGE...")
    main(Path(sys.argv[1]), int(sys.argv[2]), [Path(path) for path in sys.argv[3:]])
