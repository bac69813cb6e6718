"""What is sent of a scene to the browser."""

from unittest.mock import Mock

import numpy as np
import viser
from gaussian_world import FRAME_NS, camera_at
from styled_world import NUM_FRAMES, clear_scene, styled

from lidarpainter_models.viewing.scene_nodes import SceneNodes

CAMERAS = [(camera_at(0.0), frame * FRAME_NS) for frame in range(NUM_FRAMES)]


def sent(scene):
    """Mean colours of the street, the car and the sky, as the browser gets them."""
    api = Mock(viser.SceneApi)
    api.add_gaussian_splats.return_value = Mock(viser.GaussianSplatHandle)
    SceneNodes(api, "/scene", scene, CAMERAS, "front")
    splats = [call.kwargs["rgbs"].mean() for call in api.add_gaussian_splats.call_args_list]
    sky = np.mean([call.args[1] for call in api.add_image.call_args_list]) / 255
    return np.array([*splats, sky])


def test_a_style_is_sent_as_it_is_in_the_middle_of_the_drive():
    scenes = (clear_scene(), styled("night"), styled("night:0..1"))
    clear, night, dusk = (sent(scene) for scene in scenes)
    assert (night < 0.7 * clear).all()
    assert ((night < dusk) & (dusk < clear)).all()
