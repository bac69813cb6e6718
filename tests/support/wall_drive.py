"""A drive past a patterned wall: depth from images has an exact answer, a car moves before it."""

import torch
from toy_street import CAR_SIZE_M, ToyStreet, world_from_car
from wall_images import image_of_wall, sideways_cameras

from lidarpainter_models.geometry.box_masks import project_boxes
from lidarpainter_models.scenes.records import RecordedView

FRAME_NS = 100_000_000
WALL_X_M = 14.0


class WallDrive(ToyStreet):
    """A car that slides past a wall and sees a moving box before it; nothing measures."""

    def __init__(self, num_frames=4):
        super().__init__(num_frames)
        self.sweeps = ()
        self.views = tuple(
            RecordedView(
                frame_index=frame,
                camera_name="front",
                timestamp_ns=frame * FRAME_NS,
                camera=camera,
                index=0,
            )
            for frame, camera in enumerate(
                sideways_cameras(num_frames, width_px=240, height_px=135)
            )
        )

    def read_image(self, view):
        image = image_of_wall(view.camera, WALL_X_M)
        pose = world_from_car(view.timestamp_ns * 1e-9)
        is_there = torch.ones(1, dtype=torch.bool)
        image[project_boxes(view.camera, pose[None], [CAR_SIZE_M], is_there, margin=1.0)] = 0.1
        return (image * 255).round().to(torch.uint8)
