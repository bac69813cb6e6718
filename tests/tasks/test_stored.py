"""What tasks store comes back as it was, or is found to be damaged."""

import math

from lidarpainter_models.evaluation.score_tables import metric_values, score_rows
from tasks.json_files import read_json, write_json


def test_json_has_no_infinity(tmp_path):
    write_json(tmp_path / "x.json", {"psnr": math.inf, "all": [math.nan, 1.5]})
    assert read_json(tmp_path / "x.json") == {"psnr": None, "all": [None, 1.5]}


SCORES = {
    "recorded": {
        "psnr": 29.5,
        "ssim": 0.9,
        "lpips": None,
        "lpips_reason": "no weights",
        "actors_psnr": 28.0,
        "num_views": 14,
        "depth_within_5_percent": 0.98,
        "recorded_poses": {"psnr": 28.0, "ssim": 0.88, "num_views": 14},
    },
    "novel": {"left-2m": {"psnr": 24.0, "ssim": 0.8, "depth_within_5_percent": 0.93}},
}


def test_every_number_has_its_truth_and_a_missing_one_its_reason():
    values = metric_values(SCORES)
    assert ("recorded", "recorded", "psnr", 29.5, None) in values
    assert ("recorded", "recorded", "lpips", None, "no weights") in values
    assert ("recorded-poses", "recorded", "ssim", 0.88, None) in values
    assert ("truth", "left-2m", "psnr", 24.0, None) in values
    assert ("depth", "left-2m", "depth_within_5_percent", 0.93, None) in values


def test_strips_are_numbers_of_their_own_protocol():
    strips = {"left": {"psnr": 25.0, "num_views": 14}, "back": {"psnr": None, "psnr_reason": "x"}}
    assert metric_values(strips) == [
        ("cross-camera", "left", "psnr", 25.0, None),
        ("cross-camera", "back", "psnr", None, "x"),
    ]


def test_the_table_puts_unpainted_beside_painted():
    rows = score_rows({**SCORES, "unpainted": SCORES})
    assert rows[0] == ["recorded, interpolated poses", 29.5, 29.5, 0.9, 0.9, 0.98, 0.98, 14]
    assert rows[2][:3] == ["recorded, inside actor boxes", 28.0, 28.0]
    assert rows[3][0] == "left-2m"
