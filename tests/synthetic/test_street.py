"""The synthetic street is exact, repeatable, and open where shifted cameras go."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.geometry.boxes import is_inside_box
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.geometry.trajectories import road_directions, shift_pose
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import (
    RigCamera,
    RigLidar,
    SyntheticStreet,
    SyntheticStreetConfig,
    write_street,
)
from lidarpainter_models.synthetic.lidar_sensor import beam_inclinations_rad, firings
from lidarpainter_models.synthetic.street import ego_from_camera
from lidarpainter_models.synthetic.textures.surfaces import StreetClass

SMALL = {"width_px": 240, "height_px": 136, "num_frames": 4}
SHIFTS = (
    Shift(),
    Shift(lateral_m=2),
    Shift(lateral_m=-2),
    Shift(lateral_m=3),
    Shift(lateral_m=-3),
    Shift(up_m=1.5),
)
NEAREST_M = 0.6


@pytest.fixture(scope="module")
def street():
    return SyntheticStreet(SyntheticStreetConfig(seed=7, **SMALL))


@pytest.fixture(scope="module")
def other_street():
    return SyntheticStreet(SyntheticStreetConfig(seed=8, **SMALL))


def front(street, frame=1):
    timestamp_ns = street.timestamps_ns[frame]
    return street.camera("front_camera", timestamp_ns), timestamp_ns


def test_the_first_ego_pose_is_the_origin(street):
    pose = street.world_from_ego(street.timestamps_ns[0])
    assert torch.allclose(pose, torch.eye(4, dtype=torch.float64), atol=1e-9)


def test_the_ego_car_drives_as_far_as_a_real_one(street, other_street):
    for driven in (street, other_street):
        first, last = (driven.world_from_ego(driven.timestamps_ns[i]) for i in (0, -1))
        travelled_m = float((last - first)[:3, 3].norm()) / (SMALL["num_frames"] - 1)
        assert 0.35 < travelled_m < 0.95


def test_equal_settings_give_equal_bytes_and_other_seeds_other_streets(street, other_street):
    again = street.changed(lambda actors: actors)  # drawn once more
    first, same, other = (s.render(*front(s)) for s in (street, again, other_street))
    for name in ("rgb", "depth_m", "semantics", "actor_index"):
        assert torch.equal(getattr(first, name), getattr(same, name))
    assert not torch.equal(first.depth_m, other.depth_m)
    assert torch.equal(street.sweep(1).points.xyz_m, again.sweep(1).points.xyz_m)


def test_a_image_shows_a_street(street, other_street):
    for shown in (street, other_street):
        image = shown.render(*front(shown))
        seen = set(image.semantics.unique().tolist())
        assert {
            StreetClass.SKY, StreetClass.ROAD, StreetClass.LANE_MARKING, StreetClass.SIDEWALK,
            StreetClass.BUILDING, StreetClass.POLE, StreetClass.SIGN, StreetClass.CAR,
        } <= seen  # fmt: skip
        assert float(image.rgb.min()) >= 0
        assert float(image.rgb.max()) <= 1
        assert float(image.rgb.std()) > 0.1
        assert ((image.depth_m == 0) == (image.semantics == StreetClass.SKY)).all()


def test_below_the_horizon_there_is_no_sky(street, other_street):
    for shown in (street, other_street):
        image = shown.render(*front(shown))
        assert (image.depth_m[shown.config.height_px // 2 + 8 :] > 0).all()


def test_larger_images_average_to_smaller_ones_with_as_many_rays(street):
    camera, timestamp_ns = front(street)
    fine = street.render(camera, timestamp_ns).rgb
    half = camera.resized(width_px=120, height_px=68)
    many = SyntheticStreet(dataclasses.replace(street.config, samples_per_axis=4))
    coarse = many.render(half, timestamp_ns).rgb
    averaged = torch.nn.functional.avg_pool2d(fine.permute(2, 0, 1), 2).permute(1, 2, 0)
    assert float((averaged - coarse).abs().mean()) < 0.01  # the rays stand at other places


def test_lidar_points_lie_on_the_rendered_depth(street):
    sweep = street.sweep(1)
    points = sweep.points
    at_once = points.time_offset_ns.abs() < 4_000_000  # ahead, in the middle of the turn
    camera = Camera(
        world_from_camera=sweep.world_from_lidar @ ego_from_camera(
            RigCamera(name="at-the-lidar", focal_per_width=1.0, forward_m=0.0, up_m=0.0)
        ),
        fx_px=1600.0, fy_px=1600.0, cx_px=240.0, cy_px=300.0, width_px=480, height_px=600,
    )  # fmt: skip
    xyz_m = points.xyz_m[at_once].to(torch.float64)
    pixels_uv, depth_m = camera.project(xyz_m)
    seen = camera.contains(pixels_uv, depth_m)
    assert int(seen.sum()) > 500
    truth_m = street.render(camera, sweep.timestamp_ns).depth_m
    u, v = pixels_uv[seen].floor().long().unbind(-1)
    around = torch.nn.functional.pad(truth_m[None, None], (1, 1, 1, 1), mode="replicate")
    patches = torch.nn.functional.unfold(around, 3)[0].reshape(9, *truth_m.shape)[:, v, u]
    margin_m = 0.05 + 3 * street.config.lidar.range_noise_m
    low, high = patches.amin(0) - margin_m, patches.amax(0) + margin_m
    agrees = (depth_m[seen] >= low) & (depth_m[seen] <= high)
    assert float(agrees.double().mean()) > 0.985  # the rest grazes edges and leaves


def test_a_sweep_has_as_many_returns_as_a_real_one(street, other_street):
    for swept in (street, other_street):
        points = swept.sweep(1).points
        assert 50_000 < points.num_points < 95_000
        assert int(points.ring.max()) <= 63
        assert int(points.time_offset_ns.abs().max()) <= 50_000_000
        assert bool(((points.intensity >= 0) & (points.intensity <= 255)).all())


def test_actors_move_with_their_boxes(street):
    moving = [index for index, actor in enumerate(street.actors(0)) if actor.is_moving]
    checked = 0
    for frame in (0, 3):
        camera, timestamp_ns = front(street, frame)
        image = street.render(camera, timestamp_ns)
        points = camera.unproject(image.depth_m)
        states = street.actors(timestamp_ns)
        for index in moving:
            mask = image.actor_index == index
            if int(mask.sum()) < 20:
                continue
            state = states[index]
            inside = is_inside_box(
                points[mask], state.world_from_box, torch.tensor(state.size_m), margin_m=0.02
            )
            assert bool(inside.all())
            checked += 1
    assert checked >= 4


def test_lidar_points_of_an_actor_lie_in_its_box_at_their_own_time(street):
    sweep = street.sweep(2)
    counts = torch.bincount(sweep.actor_index.long() + 1)[1:]
    index = int(torch.argmax(counts[:4]))  # a moving car
    mask = sweep.actor_index == index
    points, offsets = sweep.points.xyz_m[mask], sweep.points.time_offset_ns[mask]
    for row in range(0, int(mask.sum()), 50):
        state = street.actors(sweep.timestamp_ns + int(offsets[row]))[index]
        inside = is_inside_box(
            points[row : row + 1], state.world_from_box, torch.tensor(state.size_m), margin_m=0.1
        )
        assert bool(inside.all())


def test_boxes_are_tight(street):
    camera, timestamp_ns = front(street)
    for state in street.actors(timestamp_ns):
        if state.category != "pedestrian":
            length, width, height = state.size_m
            assert 3.5 < length < 6.0
            assert 1.6 < width < 2.4
            assert 1.3 < height < 2.6
    assert camera.width_px == street.config.width_px


def test_enough_cars_move_both_ways(street, other_street):
    for driven in (street, other_street):
        before, after = (
            driven.actors(driven.timestamps_ns[0]),
            driven.actors(driven.timestamps_ns[3]),
        )
        steps = [
            float((late.world_from_box - early.world_from_box)[0, 3])
            for early, late in zip(before, after, strict=True)
            if early.is_moving and early.category != "pedestrian"
        ]
        assert len(steps) >= 4
        assert min(steps) < 0 < max(steps)


def assert_open_around(street, position, timestamp_ns):
    """No surface near a place, in any direction but straight down."""
    for yaw_rad in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        rig = RigCamera(name="probe", focal_per_width=0.5, yaw_rad=yaw_rad)
        pose = ego_from_camera(rig)
        pose[:3, 3] = position
        camera = Camera(
            world_from_camera=pose, fx_px=8, fy_px=8, cx_px=8, cy_px=8, width_px=16, height_px=16
        )
        depth_m = street.render(camera, timestamp_ns).depth_m
        range_m = depth_m * camera.pixel_directions().norm(dim=-1)
        nearest_m = float(range_m[depth_m > 0].min())
        assert nearest_m > NEAREST_M, f"{nearest_m:.2f} m to the next surface at {position}"


def check_shifted_cameras(street):
    poses = torch.stack([street.world_from_ego(t) for t in street.timestamps_ns])
    directions = road_directions(poses)
    for frame in range(0, len(street.timestamps_ns), max(len(street.timestamps_ns) // 4, 1)):
        camera, timestamp_ns = front(street, frame)
        for shift in SHIFTS:
            pose = shift_pose(camera.world_from_camera, directions[frame], shift)
            assert_open_around(street, pose[:3, 3], timestamp_ns)
            below = street.render(looking_down(pose[:3, 3]), timestamp_ns)
            on_road = (below.semantics == StreetClass.ROAD) | (
                below.semantics == StreetClass.LANE_MARKING
            )
            assert bool(on_road.all()), f"{shift.name} at frame {frame} is not above the road"


def looking_down(position):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]], dtype=torch.float64)
    pose[:3, 3] = position
    return Camera(
        world_from_camera=pose, fx_px=40, fy_px=40, cx_px=4, cy_px=4, width_px=8, height_px=8
    )


@pytest.mark.slow
def test_shifted_cameras_are_above_the_road_and_inside_nothing(street, other_street):
    check_shifted_cameras(street)
    check_shifted_cameras(other_street)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20, 28))
def test_shifted_cameras_are_free_on_every_street(seed):
    config = SyntheticStreetConfig(seed=seed, width_px=64, height_px=36, num_frames=28)
    check_shifted_cameras(SyntheticStreet(config))


def test_the_rig_looks_ahead_and_to_both_sides(street):
    timestamp_ns = street.timestamps_ns[0]
    ahead = {
        name: street.camera(name, timestamp_ns).world_from_camera[:3, 2]
        for name in ("front_camera", "front_left_camera", "front_right_camera")
    }
    assert float(ahead["front_camera"][0]) > 0.99
    assert float(ahead["front_left_camera"][1]) > 0.8
    assert float(ahead["front_right_camera"][1]) < -0.8
    with pytest.raises(ConfigError, match="no camera 'rear'"):
        street.camera("rear", timestamp_ns)


@pytest.mark.parametrize(
    "generator", [None, {"name": "something else"}, {"name": "lidarpainter synthetic street"}]
)
def test_a_manifest_of_another_origin_is_refused(generator):
    with pytest.raises(SceneError, match="expected"):
        SyntheticStreet.from_manifest({"dataset": "a", "sequence": "b", "generator": generator})


def small_config(**changes):
    settings = {
        "seed": 7,
        "num_frames": 2,
        "width_px": 64,
        "height_px": 36,
        "lidar": RigLidar(columns=200),
        **changes,
    }
    return SyntheticStreetConfig(**settings)


def test_a_written_street_reads_back_and_is_rebuilt_from_its_manifest(tmp_path, street):
    told = []
    path = write_street(small_config(), tmp_path, progress=lambda *done: told.append(done))
    assert told == [(1, 2), (2, 2)]
    scene = DrivingScene.open(path)
    assert (scene.dataset, scene.sequence) == ("synthetic", "street-0007")
    assert len(scene.views) == 6
    assert len(scene.sweeps) == 2
    view = next(v for v in scene.views if v.key == (1, "front_camera"))
    truth = street.render(
        street.camera("front_camera", view.timestamp_ns).resized(width_px=64, height_px=36),
        view.timestamp_ns,
    )
    recorded = scene.read_image(view).float() / 255
    assert float((recorded - truth.rgb).abs().mean()) < 0.03  # JPEG and sensor noise
    tracks = {track.actor_id: track for track in scene.tracks}
    states = street.actors(view.timestamp_ns)
    assert set(tracks) == {state.actor_id for state in states}
    state = states[0]
    pose = tracks[state.actor_id].pose_at(view.timestamp_ns)
    assert torch.allclose(pose, state.world_from_box, atol=1e-6)
    rebuilt = SyntheticStreet.from_manifest(scene.manifest)
    assert rebuilt.config == small_config()
    assert torch.equal(rebuilt.render(*front(street)).rgb, street.render(*front(street)).rgb)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, "seed"),
        ({"num_frames": 0}, "frame"),
        ({"width_px": 2}, "8 x 8"),
        ({"cameras": ()}, "at least one camera"),
        ({"cameras": (RigCamera(name="a", focal_per_width=1),) * 2}, "same name"),
    ],
)
def test_senseless_settings_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        small_config(**changes)


def test_settings_survive_json():
    config = small_config(pose_noise_m=0.1, lidar=RigLidar(beams=16))
    assert SyntheticStreetConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with pytest.raises(ConfigError, match="not a synthetic street's settings"):
        SyntheticStreetConfig.from_dict({**config.to_dict(), "colour": 1})


@pytest.mark.parametrize("beams", [1, 16, 32, 64])
def test_beams_are_chosen_from_the_real_ones(beams):
    inclinations = beam_inclinations_rad(beams)
    assert inclinations.shape == (beams,)
    assert set(inclinations) <= set(beam_inclinations_rad(64))


def test_the_turn_passes_ahead_in_its_middle():
    offset_s, azimuth_rad = firings(RigLidar(columns=100), 0.1)
    assert abs(azimuth_rad[np.argmin(np.abs(offset_s))]) < 0.05
    assert azimuth_rad[0] > 0 > azimuth_rad[-1]  # clockwise
