"""The promise is kept on a street that nobody tuned on."""

import pytest
import torch
from confidence_trials import trials, true_psnr_db
from tiny_street import FRONT, tiny_street

import lidarpainter_models as lp
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.evaluation.envelope import DIRECTIONS, MovedViews, trust_envelope
from lidarpainter_models.evaluation.view_confidence import BUNDLED, GOOD_DB
from lidarpainter_models.synthetic import RigLidar
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

SEED = 401
"""Of the calibration are 101 to 107 and 201 to 205."""
WIDTH_PX, HEIGHT_PX = 160, 90
EACH = 3


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """A short fit of a street, recorded as well as the default rig does."""
    street = tiny_street(
        SEED,
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
        num_frames=10,
        samples_per_axis=2,
        cameras=DEFAULT_CAMERAS[:1],
        lidar=RigLidar(),
    )
    scene = lp.open_scene(lp.write_street(street, tmp_path_factory.mktemp("street")))
    split = lp.split_views(scene, "alternate", (FRONT,))
    size = lp.ObservationConfig(width_px=WIDTH_PX)
    seen = lp.prepare_observations(scene, split, size)
    fitted = lp.fit_gaussians(seen, lp.FitConfig(steps=800)).scene
    gatherer = EvidenceGatherer(fitted, seen.lidar_map, seen.views)
    return MovedViews(scene=scene, gatherer=gatherer, observation=size)


@pytest.mark.slow
def test_nine_of_ten_frames_inside_the_envelope_are_good(views):
    (stretch,) = trust_envelope(views, [FRONT], BUNDLED)["stretches"]
    generator = torch.Generator().manual_seed(0)
    is_good = []
    for name, (levels, step_of) in DIRECTIONS.items():
        assert stretch[name] < levels[-1] or name == "ahead_m", name
        for share in torch.rand(EACH if stretch[name] else 0, generator=generator).tolist():
            for view in views.scene.views_of(FRONT):
                camera = views.camera(view, step_of(stretch[name] * share))
                if camera is not None:
                    is_good.append(true_psnr_db(views, camera, view) >= GOOD_DB)
    assert len(is_good) >= 50
    assert sum(is_good) >= 0.9 * len(is_good)


@pytest.mark.slow
def test_what_is_said_of_frames_from_anywhere_follows_the_truth(views):
    drawn = list(trials(views, FRONT, 60, seed=0))
    said = torch.tensor([BUNDLED.of(one.evidence).predicted_db for one in drawn])
    true = torch.tensor([one.psnr_db for one in drawn])
    assert float(torch.corrcoef(torch.stack([said, true]))[0, 1]) > 0.9
    assert float((said - true).abs().mean()) < 2.0
