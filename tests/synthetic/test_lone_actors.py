"""An actor alone looks as it does in its street."""

import pytest
import torch

from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig
from lidarpainter_models.synthetic.lone_actors import LoneActor


@pytest.mark.slow
def test_a_lone_car_shows_what_the_street_shows_of_it():
    """In the view of the recording camera; at its edges and where others stand before it not."""
    config = SyntheticStreetConfig(
        seed=7, width_px=240, height_px=136, num_frames=4, samples_per_axis=2
    )
    street = SyntheticStreet(config)
    timestamp_ns = street.timestamps_ns[1]
    camera = street.camera("front_camera", timestamp_ns)
    whole = street.render(camera, timestamp_ns)
    counts = torch.bincount(whole.actor_index[whole.actor_index >= 0])
    index = int(counts.argmax())
    lone = LoneActor(street=street, actor_index=index, timestamp_ns=timestamp_ns)
    box = street.actors(timestamp_ns)[index].world_from_box.double()
    alone = lone.render(camera.at(invert_rigid(box) @ camera.world_from_camera.double()))
    is_shown = whole.actor_index == index
    assert float(alone.is_covered[is_shown].float().mean()) > 0.97
    error = (alone.rgb - whole.rgb).abs().mean(dim=2)[is_shown & alone.is_covered]
    assert float(error.median()) < 0.01
    assert float(error.mean()) < 0.04
    assert bool((alone.rgb[~alone.is_covered] <= 1).all())
