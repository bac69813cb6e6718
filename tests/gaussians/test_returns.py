"""What a LiDAR would measure of a street is learnt from some of its sweeps and holds for others."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import camera_at, round_gaussians, scene_of
from styled_world import place
from tiny_street import tiny_street

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.evaluation.lidar_scores import LidarEvaluation, chamfer_m2
from lidarpainter_models.gaussians.lidar_returns.channel import (
    channel_from_arrays,
    measured_ranges,
)
from lidarpainter_models.gaussians.lidar_returns.fitting import fit_lidar
from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle
from lidarpainter_models.kernels.ray_gaussians import RayHits
from lidarpainter_models.lidar.firings import mounted_lidar, recorded_rays
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import write_street
from lidarpainter_models.weather.mix import StyleMix

QUICK = LidarConfig(
    num_surfels=20_000, steps=60, rays_per_step=4096, rays_per_sweep=10_000, hits=16
)
TRAIN, TEST = (0, 2, 4), (1, 3)


class Learnt:
    """A street, its actors without any Gaussian, and what was learnt of its LiDAR."""

    def __init__(self, folder):
        config = tiny_street(seed=11, num_frames=5)
        self.log = DrivingScene.open(write_street(config, folder))
        moving = [track for track in self.log.tracks if track.is_moving]
        self.scene = scene_of(GaussianSet.empty(), [camera_at(0.0)], moving)
        self.lidar = mounted_lidar(self.log, self.log.lidar_names[0], TRAIN)
        self.channel = self.fit()

    def fit(self):
        return fit_lidar(self.log, self.scene, self.lidar, TRAIN, QUICK)

    def rays(self, frame=1):
        sweep = next(sweep for sweep in self.log.sweeps if sweep.frame_index == frame)
        return recorded_rays(self.log, sweep, self.lidar)


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    return Learnt(tmp_path_factory.mktemp("store"))


def usual_answer(learnt):
    """Of how many rays it is right to say always that they come back, or never."""
    share = learnt.rays().is_returned.double().mean().item()
    return max(share, 1 - share)


def test_held_out_sweeps_are_told_to_a_few_centimetres(learnt):
    evaluation = LidarEvaluation(scene=learnt.log, lidar=learnt.lidar, test_frames=TEST)
    scores = evaluation.scores(learnt.channel, learnt.scene)
    told = scores["neurad-studio"]
    # a quick fit of a coarse sensor; the noise of a range is 2 cm
    assert scores["own"]["median_error_static_m"] < 0.06
    assert told["median_squared_depth_m2"] < 0.01
    assert told["ray_drop_accuracy"] > usual_answer(learnt) + 0.05
    assert scores["num_sweeps"] == 2
    own = scores["own"]
    assert own["median_error_silhouette_m"] > own["median_error_static_m"]
    assert own["median_error_car_m"] < 0.1  # parked or driving


def test_a_channel_comes_back_from_its_arrays_bit_for_bit(learnt):
    back = channel_from_arrays(*learnt.channel.to_arrays())
    rays = learnt.rays()
    first, again = (one.simulated(learnt.scene, rays, seed=3) for one in (learnt.channel, back))
    pairs = zip(vars(first).values(), vars(again).values(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)


def test_a_channel_of_another_version_or_in_pieces_is_refused(learnt):
    arrays, metadata = learnt.channel.to_arrays()
    with pytest.raises(SceneError, match="has schema 9"):
        channel_from_arrays(arrays, metadata | {"schema": 9})
    arrays.pop("strength")
    with pytest.raises(SceneError, match="incomplete"):
        channel_from_arrays(arrays, metadata)


def test_seeds_draw_and_no_seed_does_not(learnt):
    rays = learnt.rays()
    sure, again = (learnt.channel.simulated(learnt.scene, rays) for _ in range(2))
    one, other = (learnt.channel.simulated(learnt.scene, rays, seed=seed) for seed in (1, 2))
    assert torch.equal(sure.range_m, again.range_m)
    assert not torch.equal(one.is_returned, other.is_returned)
    near = (one.range_m - sure.range_m).abs()[sure.is_returned]
    assert 0 < near.median() < 0.2


def test_who_has_left_the_scene_is_met_no_more(learnt):
    rays = learnt.rays()
    met = learnt.channel.simulated(learnt.scene, rays)
    alone = scene_of(GaussianSet.empty(), [camera_at(0.0)])
    left = learnt.channel.simulated(alone, rays)
    assert (met.body > 0).sum() > 20
    assert not (left.body > 0).any()
    uncovered = (met.body > 0) & (left.alpha > 0.5)
    assert uncovered.any()
    assert (left.range_m >= met.range_m - 1e-4)[uncovered].float().mean() > 0.9


def test_who_has_come_into_the_scene_is_met_and_throws_a_shadow(learnt):
    rays = learnt.rays()
    before = learnt.channel.simulated(learnt.scene, rays)
    ahead = (before.range_m > 12) & (rays.direction[:, 0] > 0.97)
    place_m = (rays.origin_m + 8 * rays.direction)[ahead].mean(dim=0)
    template = learnt.log.tracks[0]
    poses = torch.eye(4).double().repeat(len(template.timestamps_ns), 1, 1)
    poses[:, :3, 3] = place_m
    guest = replace(template, actor_id="guest", is_moving=True, world_from_box=poses)
    tracks = [*learnt.scene.actors.recorded_tracks, guest]
    ball = round_gaussians(
        torch.zeros(1, 3), torch.ones(1, 3), sigma_m=0.4, body=len(tracks), opacity=0.99
    )
    changed = scene_of(ball, [camera_at(0.0)], tracks)
    after = learnt.channel.simulated(changed, rays)
    hit = after.body == len(tracks)
    assert hit.sum() > 20
    assert (after.range_m < before.range_m)[hit & before.is_returned].float().mean() > 0.95


def test_fog_takes_what_is_far_and_returns_itself(learnt):
    rays = learnt.rays()
    clear = learnt.channel.simulated(learnt.scene, rays, seed=1)
    mix = StyleMix.parse("foggy", visibility_m=60.0)
    foggy = replace(learnt.scene, style=SceneStyle(mix=mix, seed=0, place=place()))
    met = learnt.channel.simulated(foggy, rays, seed=1)
    far, air = clear.is_returned & (clear.range_m > 35), met.is_returned & (met.body < 0)
    assert far.sum() > 100
    assert (met.is_returned & ~air)[far].float().mean() < 0.1
    assert air.sum() > 100
    assert bool((met.range_m <= clear.range_m + 1e-4)[air & (clear.alpha > 0.9)].all())


def hits(ranges_m, responses):
    count = len(ranges_m)
    rows, ones = torch.arange(count)[None], torch.ones(1, count)
    columns = torch.tensor([responses]), torch.tensor([ranges_m])
    return RayHits(rows, *columns, ones, ones)


@pytest.mark.parametrize(
    ("ranges_m", "responses", "second_m", "row"),
    [
        ([10.0, 10.1, 14.0, 14.1], [0.4, 0.4, 0.6, 0.9], 14.05, 2),  # behind an edge
        ([5.0, 10.0], [0.35, 0.9], 5.0, 0),  # before what stops more of it
        ([10.0, 10.5], [0.6, 0.9], 0.0, None),  # one pulse
        ([10.0, 15.0], [0.8, 0.9], 0.0, None),  # too little is left
    ],
)
def test_a_second_return_is_what_stops_a_good_part_elsewhere(ranges_m, responses, second_m, row):
    met = hits(ranges_m, responses)
    through = torch.cumprod(1 - met.response, dim=1)
    median_m = met.range_m[0, int((through < 0.5).int().argmax())]
    _, found_m, found = measured_ranges(met, torch.ones(4), median_m[None])
    assert found_m.item() == pytest.approx(second_m, abs=0.1)
    if row is not None:
        assert found.item() == row


def test_sensors_with_two_returns_tell_both_the_nearest_first(learnt):
    met = learnt.channel.simulated(learnt.scene, learnt.rays(), seed=1)
    one, two = met.returns(1), met.returns(2)
    assert bool((one.number == 0).all())
    assert len(one.ray) == int(met.is_returned.sum())
    twice = torch.bincount(two.ray) == 2
    assert 5 < int(twice.sum()) < 0.3 * len(one.ray)
    nearer, farther = (two.number == number for number in (0, 1))
    assert int(farther.sum()) == int(twice.sum())
    first_m, last_m = torch.zeros(len(met.range_m)), torch.zeros(len(met.range_m))
    first_m[two.ray[nearer]], last_m[two.ray[farther]] = two.range_m[nearer], two.range_m[farther]
    assert bool((last_m > first_m)[two.ray[farther]].all())


def test_held_out_sweeps_are_needed_to_judge_by(learnt):
    evaluation = LidarEvaluation(scene=learnt.log, lidar=learnt.lidar, test_frames=())
    with pytest.raises(ConfigError, match="was held out to judge by"):
        evaluation.scores(learnt.channel, learnt.scene)


def test_chamfer_counts_both_ways_over_those_measured():
    told, measured = torch.tensor([[0.0, 0, 0], [3, 0, 0]]), torch.tensor([[1.0, 0, 0]])
    assert chamfer_m2(told, measured) == pytest.approx(1 + 4 + 1)


@pytest.mark.parametrize("changes", [{"steps": 0}, {"hits": 1}, {"num_surfels": -1}])
def test_settings_that_learn_nothing_are_refused(changes):
    with pytest.raises(ConfigError, match=r"lidar\."):
        LidarConfig(**changes)
