"""What a LiDAR would measure of a street is learnt from some of its sweeps and holds for others."""

from dataclasses import replace

import pytest
import torch
from gaussian_world import camera_at, round_gaussians, scene_of
from tiny_street import tiny_street

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.evaluation.lidar_scores import LidarEvaluation, chamfer_m2
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.returns.channel import channel_from_arrays
from lidarpainter_models.gaussians.returns.fitting import fit_lidar
from lidarpainter_models.gaussians.returns.settings import LidarConfig
from lidarpainter_models.lidar.firings import mounted_lidar, recorded_rays
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic import write_street

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
