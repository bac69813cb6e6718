"""Make the README's moving picture from what `lidarpainter render --postpaint` wrote.

python scripts/moving_picture.py SCENE_FOLDER RENDER_FOLDER OUT.webp
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from lidarpainter_models.scenes.driving_scene import DrivingScene

PANEL_PX = (400, 225)
FRAME_MS = 120
QUALITY = 60
LABELS = ("recorded", "2 m to the left, as fitted", "2 m to the left, painted")


def panel(bgr_u8: np.ndarray, label: str) -> np.ndarray:
    """An image of a third of the width, with its name on it."""
    small = cv2.resize(bgr_u8, PANEL_PX, interpolation=cv2.INTER_AREA)
    place, font = (8, PANEL_PX[1] - 10), cv2.FONT_HERSHEY_SIMPLEX
    return cv2.putText(small, label, place, font, 0.5, (255, 255, 255), 1, cv2.LINE_AA)


def main(scene_folder: Path, rendered: Path, out: Path) -> None:
    """Write one frame per recorded moment."""
    scene = DrivingScene.open(scene_folder)
    about = json.loads((rendered / "trajectory.json").read_text("utf-8"))
    recorded = {view.frame_index: view for view in scene.views_of("front_camera")}
    animation = cv2.Animation()
    frames = []
    for image in about["images"]:
        rgb_u8 = scene.read_image(recorded[image["frame_index"]]).numpy()
        files = (rendered / "unpainted" / image["file"], rendered / image["file"])
        shown = [cv2.cvtColor(rgb_u8, cv2.COLOR_RGB2BGR), *(cv2.imread(str(f)) for f in files)]
        frames.append(np.hstack([panel(*pair) for pair in zip(shown, LABELS, strict=True)]))
    animation.frames = frames
    animation.durations = np.full(len(frames), FRAME_MS)
    cv2.imwriteanimation(str(out), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
