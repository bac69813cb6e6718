"""A confidence is a probability: what is said of frames and what becomes of them agree."""

import math

import pytest
import torch
from confidence_fit import calibrated, expected_calibration_error

from lidarpainter_models.conditioning.view_evidence import ViewEvidence
from lidarpainter_models.evaluation.view_confidence import BUNDLED, GOOD_DB, Calibration

NAMES = ("expected_db", "support")
FULL = dict.fromkeys(ViewEvidence.__dataclass_fields__, 1.0)


def evidence(**changes):
    return ViewEvidence(**(FULL | changes))


def line(**changes):
    values = {
        "intercept_db": 2.0,
        "weights": {"expected_db": 0.5, "support": 10.0},
        "offset_db": 0.0,
        "spread_db": 2.0,
        "record": "made up",
    }
    return Calibration(**(values | changes))


def test_the_prediction_is_the_weighted_sum():
    said = line().of(evidence(expected_db=30.0, support=0.8))
    assert said.predicted_db == pytest.approx(2 + 15 + 8)
    assert said.confidence == pytest.approx(0.5)
    assert not said.is_promised
    surer = line(offset_db=-2 * math.log(9) - 1e-6).of(evidence(expected_db=30.0, support=0.8))
    assert surer.confidence == pytest.approx(0.9)
    assert surer.is_promised


def test_no_evidence_at_all_is_no_error():
    assert line(spread_db=1e-3).of(evidence(expected_db=0.0, support=0.0)).confidence == 0


def test_the_error_of_calibration_is_that_of_bins():
    # two bins of equal size: 0.1 too sure in one, right in the other
    said = [0.85] * 4 + [0.25] * 4
    good = [True, True, True, False, True, False, False, False]
    assert expected_calibration_error(said, good) == pytest.approx(0.05)
    assert expected_calibration_error([1.0, 0.0], [True, False]) == 0
    assert expected_calibration_error([1.0], [False]) == 1


@pytest.fixture(scope="module")
def drawn():
    """Frames of six streets whose truth follows a line, with noise of 1 dB."""
    generator = torch.Generator().manual_seed(0)
    found, psnr, streets = [], [], []
    for number in range(600):
        expected, support = torch.rand(2, generator=generator).tolist()
        noise = float(torch.randn(1, generator=generator))
        one = evidence(expected_db=15 + 20 * expected, support=support)
        found.append(one)
        psnr.append(line().of(one).predicted_db + 8 * one.support + noise)
        streets.append(f"street-{number % 6}")
    return found, psnr, streets


def test_a_calibration_finds_the_line_and_how_sure_it_is(drawn):
    found, psnr, streets = drawn
    made = calibrated(found, psnr, streets, names=NAMES, record="six streets")
    assert made.weights["expected_db"] == pytest.approx(0.5, abs=0.05)
    assert made.weights["support"] == pytest.approx(18, abs=1)
    # a normal error of 1 dB is a logistic one of about 0.6
    assert 0.4 < made.spread_db < 0.8
    assert abs(made.offset_db) < 0.3
    said = [made.of(one).confidence for one in found]
    good = [one >= GOOD_DB for one in psnr]
    assert expected_calibration_error(said, good) < 0.05


def test_more_evidence_never_lowers_a_confidence(drawn):
    found, psnr, streets = drawn
    made = calibrated(found, [-one for one in psnr], streets, names=NAMES, record="upside down")
    assert min(made.weights.values()) >= 0
    assert min(BUNDLED.weights.values()) >= 0
