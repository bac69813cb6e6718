"""Put folders of images side by side into one moving picture.

python scripts/moving_picture.py OUT.webp "LABEL=FOLDER" ...

Each folder holds an image a moment, in the order of their names: what `lidarpainter render` and
`stylize` write, or the recorded images of `lidarpainter export --format nerfstudio`.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

PANEL_PX = (400, 225)
FRAME_MS = 120
QUALITY = 50
SUFFIXES = (".png", ".jpg")


def panel(file: Path, label: str) -> np.ndarray:
    """An image at the size of a panel, with its name on it."""
    image = cv2.imread(str(file))
    if image is None:
        sys.exit(f"{file}: expected an image")
    small = cv2.resize(image, PANEL_PX, interpolation=cv2.INTER_AREA)
    place, font = (8, PANEL_PX[1] - 10), cv2.FONT_HERSHEY_SIMPLEX
    return cv2.putText(small, label, place, font, 0.5, (255, 255, 255), 1, cv2.LINE_AA)


def main(out: Path, *named: str) -> None:
    """Write one frame per moment."""
    columns = []
    for one in named:
        label, _, folder = one.partition("=")
        files = sorted(file for file in Path(folder).iterdir() if file.suffix in SUFFIXES)
        columns.append([panel(file, label) for file in files])
    animation = cv2.Animation()
    animation.frames = [np.hstack(moment) for moment in zip(*columns, strict=True)]
    animation.durations = [FRAME_MS] * len(animation.frames)
    cv2.imwriteanimation(str(out), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
