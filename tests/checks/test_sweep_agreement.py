"""Two sweeps are compared by the surfaces that both saw."""

import numpy as np
import pytest

from lidarpainter_models.checks.sweep_agreement import nearest_gap_m, points_near, sweep_offset_m
from lidarpainter_models.readers import ingest_scene
from lidarpainter_models.scenes.driving_scene import DrivingScene


@pytest.fixture
def street():
    """Draws points at chance on a road and the walls beside it, as no two sweeps hit the same."""

    def draw(seed, num_points=6000):
        generator = np.random.default_rng(seed)
        along, across = generator.uniform(-20, 20, num_points), generator.uniform(-8, 8, num_points)
        road = np.stack([along, across, np.zeros(num_points)], axis=1)
        walls = np.stack([along, 8 * np.sign(across), generator.uniform(0, 6, num_points)], axis=1)
        return np.concatenate([road, walls])

    return draw


def test_sweeps_in_one_place_agree_however_thin_they_are(street):
    assert sweep_offset_m(street(0), street(1)) < 2e-3
    assert sweep_offset_m(street(0), street(1, 3000)) < 2e-3
    assert nearest_gap_m(street(0), street(1, 3000)) > 0.1


@pytest.mark.parametrize("offset_m", [(0.0, 0.0, 0.3), (0.0, 0.5, 0.2)])
def test_shifted_sweep_is_found(street, offset_m):
    found_m = sweep_offset_m(street(0), street(1) + np.array(offset_m))
    assert found_m == pytest.approx(np.linalg.norm(offset_m), rel=0.1)


def test_turned_sweep_is_found(street):
    cosine, sine = np.cos(0.05), np.sin(0.05)
    turned = street(1) @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    expected_m = np.median(np.linalg.norm(turned - street(1), axis=1))
    assert sweep_offset_m(street(0), turned) == pytest.approx(expected_m, rel=0.2)


def test_what_one_sweep_alone_holds_does_not_count(street):
    whole, half = street(0), street(1)
    half = half[half[:, 0] > 5]
    assert max(sweep_offset_m(whole, half), sweep_offset_m(half, whole)) < 2e-3
    chance = np.random.default_rng(2).uniform(-20, 20, (6000, 3)) + np.array([0, 0, 25])
    assert sweep_offset_m(whole, np.concatenate([half, chance])) < 2e-3


def test_sweeps_without_a_common_surface_are_not_compared(street):
    apart = street(0)[:, [0, 2, 1]] + np.array([0, 50, 0])
    assert sweep_offset_m(street(1), apart) is None
    assert sweep_offset_m(street(1), np.empty((0, 3))) is None
    assert nearest_gap_m(street(1), np.empty((0, 3))) is None


@pytest.fixture(scope="module")
def real_sweeps(shared_folder, tmp_path_factory):
    root, store = shared_folder / "data" / "pandaset", tmp_path_factory.mktemp("store")
    options = {"frames": slice(0, 2), "cameras": ("front_camera",)}
    scene = DrivingScene.open(ingest_scene("pandaset", root, "002", store, **options))
    centres_m = scene.world_from_ego[:, :3, 3]
    return [
        points_near(scene.read_points(frame).xyz_m, centre_m)
        for frame, centre_m in zip(scene.frame_indices, centres_m, strict=True)
    ]


def test_sweeps_of_the_real_log_agree(real_sweeps):
    assert sweep_offset_m(*real_sweeps) < 0.015


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_moved_sweep_of_the_real_log_is_found(real_sweeps, axis):
    first_m, second_m = real_sweeps
    moved_m = second_m + 0.2 * np.eye(3)[axis]
    assert sweep_offset_m(first_m, moved_m) == pytest.approx(0.2, abs=0.02)
