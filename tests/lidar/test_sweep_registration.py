"""Sweeps tell how the car pitched and rolled beside its recorded poses."""

import math

import pytest
import torch

from lidarpainter_models.lidar.sweep_registration import register_sweeps
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, RigLidar

STREET = SyntheticStreetConfig(
    seed=7,
    num_frames=12,
    width_px=64,
    height_px=36,
    cameras=DEFAULT_CAMERAS[:1],
    lidar=RigLidar(columns=900),
)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return DrivingScene.open(write_street(STREET, tmp_path_factory.mktemp("street")))


def recorded_wrongly(street, *, turn_rad, lift_m=0.0, seed=0):
    """The street as if recorded by a car that rolls, pitches and heaves unknown to its poses."""
    generator = torch.Generator().manual_seed(seed)
    tangent = torch.randn(STREET.num_frames, 6, generator=generator, dtype=torch.float64)
    tangent *= torch.tensor([turn_rad, turn_rad, turn_rad / 4, 0.0, 0.0, lift_m])
    tangent -= tangent.mean(dim=0)
    planted = EgoCorrections(
        times_ns=street.frame_timestamps_ns,
        centre_m=street.world_from_ego[:, :3, 3].clone(),
        tangent=tangent,
    )
    return street.corrected(planted), tangent


def test_exact_poses_stay_as_they_are(street):
    found = register_sweeps(street).tangent
    assert float(found[:, :3].abs().max()) < 4e-4
    assert float(found[:, 3:].abs().max()) < 0.02


@pytest.mark.parametrize("seed", [0, 1])
def test_roll_pitch_and_heave_are_found(street, seed):
    scene, planted = recorded_wrongly(street, turn_rad=2e-3, lift_m=0.02, seed=seed)
    left = register_sweeps(scene).tangent + planted
    assert float(left[:, :2].std()) < 0.3 * float(planted[:, :2].std())
    assert float(left[:, 5].std()) < 0.4 * float(planted[:, 5].std())


def test_everything_is_moved_to_where_it_was(street):
    scene, _ = recorded_wrongly(street, turn_rad=2e-3)
    corrections = scene.corrections
    assert len(scene.views) == len(street.views)
    for was, now in zip(street.views, scene.views, strict=True):
        moved = corrections.at(was.timestamp_ns)
        torch.testing.assert_close(
            now.camera.world_from_camera, moved @ was.camera.world_from_camera
        )
    sweep = street.sweeps[3]
    points = street.read_column(sweep, "xyz_m")
    moved = corrections.at(sweep.timestamp_ns).float()
    expected = points @ moved[:3, :3].T + moved[:3, 3]
    torch.testing.assert_close(scene.read_column(sweep, "xyz_m"), expected)
    assert not torch.equal(street.read_column(sweep, "xyz_m"), expected)


def test_corrections_are_linear_between_their_times_and_end_with_them():
    tangent = torch.zeros(2, 6, dtype=torch.float64)
    tangent[1, 2], tangent[1, 3] = 0.02, 1.0
    centre_m = torch.tensor([[5.0, 0.0, 0.0], [5.0, 0.0, 0.0]]).double()
    path = EgoCorrections(times_ns=torch.tensor([0, 100]), centre_m=centre_m, tangent=tangent)
    half = path.at(50)
    assert math.atan2(half[1, 0], half[0, 0]) == pytest.approx(0.01)
    place = half @ torch.tensor([5.0, 0.0, 0.0, 1.0]).double()
    torch.testing.assert_close(place[:3], torch.tensor([5.5, 0.0, 0.0]).double())
    torch.testing.assert_close(path.at(-10), torch.eye(4).double())
    torch.testing.assert_close(path.at(500), path.at(100))
    assert EgoCorrections.none().at(3).equal(torch.eye(4).double())


def test_a_sweep_that_met_nothing_stays_as_recorded_and_harms_no_other(street, monkeypatch, capfd):
    scene, planted = recorded_wrongly(street, turn_rad=2e-3)
    read, empty = scene.read_positions, scene.swept_frames[4]
    monkeypatch.setattr(
        scene, "read_positions", lambda frame: read(frame)[: 0 if frame == empty else None]
    )
    found = register_sweeps(scene).tangent
    assert not bool(found[4].any())
    others = [row for row in range(STREET.num_frames) if row != 4]
    assert float((found + planted)[others, :2].std()) < 0.4 * float(planted[:, :2].std())
    assert capfd.readouterr().out == ""


def test_one_swept_frame_tells_nothing(street):
    one = DrivingScene.open(street.path)
    one.sweeps = one.sweeps_of(one.swept_frames[0])
    assert len(register_sweeps(one)) == 0
