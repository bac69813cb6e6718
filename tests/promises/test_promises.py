"""What the product promises holds: on a street with exact truth, and on a real log if there is one.

Each bound lies below what three seeds reached by twice what they differ. Nothing else is asked
here, so that a failure says that scenes got worse, not which part did it.
"""

import pytest
from short_reconstruction import ShortReconstruction, beside, depth_beside

import lidarpainter_models as lp
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.synthetic import RigCamera
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

SIDE = RigCamera(name="side_camera", focal_per_width=0.8, yaw_rad=-0.35, left_m=-0.5)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A street that no painter was trained on, with a second camera that no fit sees."""
    config = lp.SyntheticStreetConfig(
        seed=3, num_frames=12, width_px=160, height_px=90, cameras=(DEFAULT_CAMERAS[0], SIDE)
    )
    folder = lp.write_street(config, tmp_path_factory.mktemp("street"))
    return ShortReconstruction(folder=folder, width_px=160)


@pytest.fixture(scope="module")
def real_log(shared_folder, tmp_path_factory):
    store = tmp_path_factory.mktemp("store")
    root = shared_folder / "data" / "pandaset"
    folder = ingest_scene("pandaset", root, "002", store, cameras=("front_camera",))
    return ShortReconstruction(folder=folder, width_px=240)


def test_painting_gains_beside_the_path_and_costs_nothing_on_it(street):
    painted, unpainted = street.scores(street.painted), street.scores(street.unpainted)
    # seeds 0, 1, 2: 0.68, 0.75, 0.84 dB; .042, .042, .039; +0.03, +0.04, +0.10 dB. A painter that
    # leaves each render as it is gains 0.47 dB, by the LiDAR's depth in its views
    assert beside(painted) - beside(unpainted) > 0.55
    assert depth_beside(painted) - depth_beside(unpainted) > 0.03
    assert painted["recorded"]["psnr"] - unpainted["recorded"]["psnr"] > -0.1
    # 31.36, 31.29, 31.35 dB and 24.87, 24.92, 25.00 dB
    assert painted["recorded"]["psnr"] > 31.1
    assert beside(painted) > 24.7


def test_painting_at_view_time_gains_where_another_camera_looks(street):
    plain = street.strips(street.painted, is_painted=False)
    painted = street.strips(street.painted, is_painted=True)
    # 27.95, 27.89, 27.95 dB; gains 0.83, 0.86, 0.79 dB
    assert plain["side_camera"] > 27.7
    assert painted["side_camera"] - plain["side_camera"] > 0.65


def test_a_real_log_is_shown_as_well_as_ever(real_log):
    scores = real_log.scores(real_log.painted)
    recorded = scores["recorded"]
    # seeds 0, 1, 2: 31.17, 31.28, 31.23 dB; 30.22, 30.12, 30.18 dB; .960; .928, .932, .930
    assert recorded["psnr"] > 31.0
    assert recorded["actors_psnr"] > 29.9
    assert recorded["depth_within_5_percent"] > 0.955
    assert depth_beside(scores) > 0.92
