"""A scene written as NCore by NVIDIA's library and read back is the same scene."""

import json

import cv2
import numpy as np
import pytest
import torch
from ncore.data import (
    FThetaCameraModelParameters,
    OpenCVFisheyeCameraModelParameters,
    OpenCVPinholeCameraModelParameters,
    ShutterType,
)
from ncore.sensors import FThetaCameraModel
from ncore_log import LICENCE, SEQUENCE, pinhole, write_ncore_log
from scene_differences import scene_differences
from written_logs import WrittenLog

from lidarpainter_models.checks.doctor import check_scene
from lidarpainter_models.errors import DataError
from lidarpainter_models.readers import list_sequences
from lidarpainter_models.readers.ncore.lenses import MAX_APART_PX, lens_of
from lidarpainter_models.readers.ncore.reader import LICENCE as NOT_STATED
from lidarpainter_models.scenes.records import RollingShutter

FTHETA = {
    "resolution": np.array([1920, 1080], np.uint64),
    "shutter_type": ShutterType.ROLLING_TOP_TO_BOTTOM,
    "principal_point": np.array([955.3, 541.9], np.float32),
    "reference_poly": FThetaCameraModelParameters.PolynomialType.ANGLE_TO_PIXELDIST,
    "pixeldist_to_angle_poly": np.array([0.0, 1.07e-3, 0.0, 2.5e-11], np.float32),
    "angle_to_pixeldist_poly": np.array([0.0, 930.0, 0.0, -24.0, 0.0, 2.0], np.float32),
    "max_angle": 1.2,
}
"""A lens of 120 degrees; the two polynomials are inverses to some pixels."""


def test_scene_comes_back_as_it_was(street, read_street):
    assert len(read_street.frame_indices) == 3
    found = scene_differences(street, read_street)
    assert found.num_other_images == found.num_unpaired_boxes == 0
    assert max(found.camera_centre_m, found.box_centre_m) < 1e-6
    assert max(found.camera_rotation_deg, found.box_rotation_deg) < 1e-5
    assert found.point_m < 1e-4  # directions and distances are float32
    assert found.intrinsics < 1e-4  # as are focal lengths


def test_doctor_accepts_the_scene(read_street):
    assert [check for check in check_scene(read_street) if check.verdict != "ok"] == []


def test_each_point_keeps_its_beam_its_strength_and_its_time(street, read_street):
    for true_sweep, sweep in zip(street.sweeps, read_street.sweeps, strict=True):
        true, points = street.read_sweep(true_sweep), read_street.read_sweep(sweep)
        assert torch.equal(points.ring, true.ring)
        assert torch.allclose(points.intensity * 255, true.intensity, atol=1e-4)
        assert torch.equal(points.return_index, torch.zeros_like(points.return_index))
        apart_ns = read_street.measured_ns(sweep) - street.measured_ns(true_sweep)
        assert int(apart_ns.abs().max()) < 1000


def test_licence_is_what_the_log_says_or_said_to_be_unstated(street, read_street, tmp_path):
    assert read_street.manifest["licence"] == LICENCE
    write_ncore_log(street, tmp_path / "log", told={"license-ish": 3})
    scene = WrittenLog("ncore", tmp_path / "log", SEQUENCE).read(tmp_path / "store")
    assert scene.manifest["licence"] == NOT_STATED


def test_archives_and_folders_of_both_versions_give_one_scene(street, read_street, tmp_path):
    for store_type, zarr_format in (("itar", 2), ("directory", 3)):
        root = tmp_path / f"{store_type}{zarr_format}"
        how = {"store_type": store_type, "zarr_format": zarr_format}
        write_ncore_log(street, root / SEQUENCE, **how)
        assert list_sequences("ncore", root) == (SEQUENCE,)
        scene = WrittenLog("ncore", root, SEQUENCE).read(root / "store")
        assert scene.content_digest == read_street.content_digest


def test_sequence_in_two_folders_is_refused(street, tmp_path):
    for folder in ("a", "b"):
        write_ncore_log(street, tmp_path / folder)
    with pytest.raises(DataError, match="lies in several folders"):
        WrittenLog("ncore", tmp_path, SEQUENCE).ingest(tmp_path / "store")


def test_rolling_shutter_and_distortion_are_taken_over(street, tmp_path):
    radial = (-0.1, 0.02, 0.001, 0.0, 0.0, 0.0)

    def lens(record):
        return pinhole(record, radial, ShutterType.ROLLING_BOTTOM_TO_TOP)

    write_ncore_log(street, tmp_path / "log", lens=lens)
    scene = WrittenLog("ncore", tmp_path / "log", SEQUENCE).read(tmp_path / "store")
    record = scene.image_record(scene.views[0])
    assert record.distortion.model == "brown"
    assert record.distortion.terms == pytest.approx((-0.1, 0.02, 0.0, 0.0, 0.001))
    assert record.rolling_shutter == RollingShutter(duration_s=0.0, direction="up")


def encoded(parameters):
    return {
        "camera_model_type": parameters.type(),
        "camera_model_parameters": json.loads(json.dumps(parameters.to_dict())),
    }


def landed(lens, rays):
    """Where a fisheye lens of ours shows directions, pixels from the corner."""
    fx_px, fy_px, cx_px, cy_px = lens.intrinsics.values()
    matrix = np.array([[fx_px, 0, cx_px], [0, fy_px, cy_px], [0, 0, 1.0]])
    points, none = rays.reshape(-1, 1, 3).astype(np.float64), np.zeros(3)
    found, _ = cv2.fisheye.projectPoints(points, none, none, matrix, lens.distortion.terms)
    return found.reshape(-1, 2)


@pytest.mark.parametrize("name", ["ANGLE_TO_PIXELDIST", "PIXELDIST_TO_ANGLE"])
def test_ftheta_camera_shows_directions_where_nvidias_model_does(name):
    reference = FThetaCameraModelParameters.PolynomialType[name]
    camera = FThetaCameraModelParameters(**FTHETA | {"reference_poly": reference})
    lens = lens_of(encoded(camera), "here")
    assert lens.direction == "down"
    pixels = np.random.default_rng(0).uniform([0, 0], [1920, 1080], (2000, 2)).astype(np.float32)
    model = FThetaCameraModel(camera, device="cpu", dtype=torch.float64)
    rays = model.image_points_to_camera_rays(torch.from_numpy(pixels)).numpy()
    apart_px = np.linalg.norm(landed(lens, rays) - pixels, axis=1)
    assert apart_px.max() < MAX_APART_PX


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"linear_cde": np.array([1, 0.01, 0], np.float32)}, "no fisheye lens comes nearer"),
        (
            {"angle_to_pixeldist_poly": np.array([40.0, 930.0], np.float32)},
            "no fisheye lens comes nearer",
        ),
        ({"angle_to_pixeldist_poly": np.array([0.0, -9.0], np.float32)}, "does not rise"),
    ],
)
def test_ftheta_camera_that_no_lens_of_ours_is_like_is_refused(changed, expected):
    with pytest.raises(DataError, match=expected):
        lens_of(encoded(FThetaCameraModelParameters(**FTHETA | changed)), "here")


def test_fisheye_camera_keeps_its_terms(street):
    camera = pinhole(street.image_record(street.views[0]))
    terms = np.array([0.1, -0.02, 0.003, -0.0004], np.float32)
    fisheye = OpenCVFisheyeCameraModelParameters(
        resolution=camera.resolution,
        shutter_type=ShutterType.ROLLING_LEFT_TO_RIGHT,
        principal_point=camera.principal_point,
        focal_length=camera.focal_length,
        radial_coeffs=terms,
        max_angle=1.0,
    )
    lens = lens_of(encoded(fisheye), "here")
    assert (lens.distortion.model, lens.direction) == ("fisheye", "right")
    assert lens.distortion.terms == pytest.approx(terms.tolist())


def test_thin_prism_windshield_and_unknown_models_are_refused(street):
    stated = encoded(pinhole(street.image_record(street.views[0])))
    given = stated["camera_model_parameters"]
    for changed, expected in (
        (stated | {"camera_model_type": "periscope"}, "camera model 'periscope', expected ideal"),
        (
            stated | {"camera_model_parameters": given | {"thin_prism_coeffs": [0, 1e-3, 0, 0]}},
            "thin prism",
        ),
        (
            stated
            | {"camera_model_parameters": given | {"external_distortion_parameters": {"a": 1}}},
            "windshield",
        ),
        (
            stated | {"camera_model_parameters": given | {"shutter_type": "SLOW"}},
            "shutter 'SLOW', expected one of GLOBAL",
        ),
    ):
        with pytest.raises(DataError, match=expected):
            lens_of(changed, "here")
    assert OpenCVPinholeCameraModelParameters.type() == stated["camera_model_type"]
