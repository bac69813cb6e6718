"""The scripts that judge published vehicles and fit their score."""

import pytest
import torch
from calibrate_assets import fitted, held_out
from judge_assets import direction_class, iou, psnr_db, summary

from lidarpainter_models.assets.expected_quality import EVIDENCE
from lidarpainter_models.synthetic.lone_actors import LoneImage


@pytest.mark.parametrize(
    ("azimuth_deg", "expected"),
    [(90, "seen"), (118, "seen"), (270, "mirrored"), (-90, "mirrored"), (0, "guessed")],
)
def test_a_direction_is_seen_mirrored_or_guessed(azimuth_deg, expected):
    assert direction_class(azimuth_deg, [[92.0, 5.0, 8.0]]) == expected


def test_who_was_seen_from_behind_has_no_mirrored_directions():
    assert direction_class(180, [[-178.0, 5.0, 8.0]]) == "seen"


def test_errors_count_inside_the_true_silhouette():
    covered = torch.zeros(4, 4, dtype=torch.bool)
    covered[:2] = True
    true = LoneImage(rgb=torch.full((4, 4, 3), 0.5), is_covered=covered)
    rgb = torch.full((4, 4, 3), 0.6)
    rgb[2:] = 0.0
    assert psnr_db(rgb, true) == pytest.approx(20.0, abs=1e-3)
    assert iou(torch.ones(4, 4, dtype=torch.bool), covered) == pytest.approx(0.5)


def lines_of(num_scenes, noise_db, seed=0):
    """Vehicles whose PSNR is 10 dB, and 8 dB more where seen."""
    random = torch.Generator().manual_seed(seed)
    lines = []
    for scene in range(num_scenes):
        for car in range(4):
            common = torch.rand(len(EVIDENCE), generator=random)
            for _ in range(24):
                evidence = common + 0.1 * torch.rand(len(EVIDENCE), generator=random)
                evidence[0] = 1.0
                db = 10 + 8 * evidence[1] + noise_db * torch.randn(1, generator=random)[0]
                lines.append(
                    {
                        "car": f"{scene}-{car}",
                        "scene_id": str(scene),
                        "evidence": evidence.tolist(),
                        "psnr_db": float(db),
                        "iou": 0.9,
                        "class": "seen",
                        "score": float(common[1]),
                        "box_iou": 0.6,
                        "box_psnr_db": 12.0,
                    }
                )
    return lines


def test_the_calibration_finds_what_counts():
    coefficients = fitted(lines_of(6, noise_db=0.5))
    assert float(coefficients[1]) == pytest.approx(8.0, abs=1.0)
    assert float(coefficients[2:].abs().max()) < 0.7


def test_streets_are_predicted_by_the_others():
    found = held_out(lines_of(6, noise_db=0.2))
    assert len(found) == 24
    scores, true_db, _ = zip(*found, strict=True)
    assert torch.corrcoef(torch.tensor([scores, true_db]))[0, 1] > 0.95


def test_the_table_has_a_row_for_each_class():
    text = summary(lines_of(2, noise_db=0.2))
    assert "seen" in text
    assert "8 vehicles" in text
    assert "Spearman of score and true mean PSNR: 1.00" in text or "0.9" in text
