"""A small street and its scene, served: what tests of the server ask."""

from contextlib import contextmanager
from functools import cached_property

import torch
from tiny_street import tiny_street

import lidarpainter_models as lp
from lidarpainter_models.evaluation.anchoring import calibration_of
from lidarpainter_models.gaussians.initialisation.scene import initialise_scene
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.gaussians.lidar_returns.fitting import fit_lidar
from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.lidar.firings import mounted_lidar
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.serving import wire
from lidarpainter_models.serving.messages import camera_message, pose_message, trajectory_message
from lidarpainter_models.serving.protos import sensorsim_pb2 as pb
from lidarpainter_models.serving.refusals import invalid
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.renderer import ServedScene
from lidarpainter_models.serving.scene_edits import SceneEdits, world_of
from lidarpainter_models.serving.scene_pool import LoadedScene, ScenePool
from lidarpainter_models.serving.server import grpc_server
from lidarpainter_models.serving.servicer import SensorsimServicer
from lidarpainter_models.synthetic import SyntheticStreet, write_street

QUICK = LidarConfig(num_surfels=20_000, steps=20, rays_per_step=4096, rays_per_sweep=10_000)


class ServedStreet:
    """The street, the scene that a fit of it starts with, and the scene that answers."""

    def __init__(self, folder, *, street=None, fit=None, num_gaussians=2000):
        self.config = street or tiny_street()
        self.street = SyntheticStreet(self.config)
        self.recording = DrivingScene.open(write_street(self.config, folder))
        self.size = lp.ObservationConfig(width_px=self.config.width_px)
        split = lp.split_views(self.recording, "alternate", None)
        self.seen = lp.prepare_observations(self.recording, split, self.size)
        if fit is None:
            self.scene = initialise_scene(
                self.seen, InitialisationConfig(num_gaussians=num_gaussians)
            )
        else:
            self.scene = lp.fit_gaussians(self.seen, fit).scene

    @cached_property
    def served(self):
        return ServedScene(
            scene_id="street",
            recorded=self.recording,
            builder=lp.ConditionBuilder(self.scene, self.seen.lidar_map, self.seen.views),
            observation=self.size,
            calibration=calibration_of(None),
        )

    @cached_property
    def returns(self):
        """What a quick look at the training sweeps says of the LiDAR."""
        frames = self.recording.frame_indices[::2]
        lidar = mounted_lidar(self.recording, self.recording.lidar_names[0], frames)
        return fit_lidar(self.recording, self.scene, lidar, frames, QUICK)

    def request(self, view, *, actors=None, pose=None, camera=None, **fields):
        """An `RGBRenderRequest` of a recorded view, its actors where they were."""
        found = camera or self.served.found(view)
        placed = self.actors_at(found.taken_ns(view.timestamp_ns)) if actors is None else actors
        stand = pose_message(found.world_from_camera if pose is None else pose)
        message = pb.RGBRenderRequest(
            scene_id="street",
            camera_intrinsics=camera_message(view.camera_name, found),
            frame_start_us=view.timestamp_ns // 1000,
            frame_end_us=view.timestamp_ns // 1000 + 1,
            sensor_pose=pb.PosePair(start_pose=stand, end_pose=stand),
            image_format=pb.PNG,
            dynamic_objects=placed,
        )
        for name, value in fields.items():
            setattr(message, name, value)
        return message

    @cached_property
    def library(self):
        """The actors of the street as assets, larger by a tenth each."""
        return FakeLibrary(world_of(self.served))

    def insertion(self, view, name, **fields):
        """An `EditAssetsRequest` by which somebody comes who stands before the camera."""
        ahead = torch.eye(4, dtype=torch.float64)
        ahead[:3, 3] = torch.tensor([0.0, 0.5, 6.0])
        turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
        ahead[:3, :3] = turn
        pose = self.served.found(view).world_from_camera @ ahead
        message = pb.EditAssetsRequest(scene_id="street")
        way = trajectory_message([view.timestamp_ns], pose[None])
        message.insert.add(id=name, trajectory=way, **fields)
        return message

    def actors_at(self, timestamp_ns):
        """Everybody who is there then, as messages."""
        poses, present = self.scene.actors.refined_poses(timestamp_ns)
        everybody = zip(self.scene.actors.recorded_tracks, poses, present, strict=True)
        return [
            placed_object(track.actor_id, pose) for track, pose, is_there in everybody if is_there
        ]


class FakeLibrary:
    """The first actors of a world, by names that tell their order."""

    def __init__(self, world):
        models = [world.model_of(track) for track in world.moving[:2]]
        self.models = {
            f"asset-{number}": one.scaled(1 + 0.1 * number) for number, one in enumerate(models)
        }
        self.names = [*self.models]
        self.categories = sorted({one.category for one in models})

    def model(self, name):
        if name not in self.models:
            raise invalid(f"asset {name[:80]!r}: not here")
        return self.models[name]

    def nearest(self, _category, size_m):
        def away(name):
            return 0.0 if size_m is None else float((self.models[name].size_m - size_m).norm())

        return min(self.names, key=away)


def placed_object(actor_id, start, end=None):
    """A `DynamicObject`."""
    pair = pb.PosePair(
        start_pose=pose_message(start), end_pose=pose_message(start if end is None else end)
    )
    return pb.DynamicObject(track_id=actor_id, pose_pair=pair)


@contextmanager
def served(street, *, has_placeholders=False, **settings):
    """A client of a server of the street."""
    import grpc

    edits = SceneEdits(
        fitted=street.served, library=street.library, has_placeholders=has_placeholders
    )
    pool = ScenePool(
        runs={"street": "run"},
        announced=("street",),
        load=lambda _run: LoadedScene(edits, 1),
        most_bytes=10,
    )
    queue = RenderQueue(most_waiting=16, limit_s=60.0)
    servicer = SensorsimServicer(scenes=pool, queue=queue, config={"painted": "false"}, **settings)
    with grpc_server(servicer, host="127.0.0.1", port=0) as port:
        size = [(f"grpc.max_{way}_message_length", wire.MOST_BYTES) for way in ("send", "receive")]
        with grpc.insecure_channel(f"127.0.0.1:{port}", options=size) as channel:
            yield channel
