"""Record a synthetic street: drive through it and store what the sensors see as a scene.

The recording is as imperfect as asked for (sensor noise, exposure gains, pose and box noise, a
camera clock that lags); the street itself stays exact and can be rebuilt from the manifest.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from lidarpainter_models.geometry.transforms import rigid_from_tangent
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, RollingShutter
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter
from lidarpainter_models.synthetic.config import RigCamera, SyntheticStreetConfig
from lidarpainter_models.synthetic.street import SEMANTIC_NAMES, SyntheticStreet
from lidarpainter_models.synthetic.truth import SimulatedSweep

DATASET = "synthetic"
LICENCE = "Apache-2.0, drawn by LidarPainter"


def street_name(config: SyntheticStreetConfig) -> str:
    """The sequence a street is stored as."""
    return f"street-{config.seed:04d}"


def write_street(
    config: SyntheticStreetConfig,
    store: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Record a street as `<store>/scenes/synthetic/street-<seed>`.

    Returns:
        The folder of the scene.
    """
    return record_street(SyntheticStreet(config), store, progress=progress)


def record_street(
    street: SyntheticStreet, store: Path, *, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Record a street that is drawn already, as `write_street` does."""
    config = street.config
    header = SceneHeader(
        licence=LICENCE,
        global_from_world=torch.eye(4, dtype=torch.float64),
        semantic_classes=dict(SEMANTIC_NAMES),
        more={"generator": street.to_generator()},
    )
    with SceneWriter(store, DATASET, street_name(config), header) as writer:
        for frame_index in range(config.num_frames):
            _record_frame(street, frame_index, writer)
            if progress is not None:
                progress(frame_index + 1, config.num_frames)
        return writer.path


def _record_frame(street: SyntheticStreet, frame_index: int, writer: SceneWriter) -> None:
    """One turn of the LiDAR and the images taken in its middle."""
    config, timestamp_ns = street.config, street.timestamps_ns[frame_index]
    rng = np.random.default_rng([config.seed, frame_index, 1])
    writer.add_frame(
        frame_index, timestamp_ns=timestamp_ns, world_from_ego=street.world_from_ego(timestamp_ns)
    )
    for rig in config.cameras:
        _record_image(street, rig, timestamp_ns, rng, writer)
    sweep = street.sweep(frame_index)
    writer.add_sweep(
        config.lidar.name,
        sweep.points,
        timestamp_ns=sweep.timestamp_ns,
        world_from_lidar=sweep.world_from_lidar,
        semantics=sweep.semantics.to(torch.uint8),
    )
    _record_boxes(street, sweep, rng, writer)


def _record_image(
    street: SyntheticStreet,
    rig: RigCamera,
    timestamp_ns: int,
    rng: np.random.Generator,
    writer: SceneWriter,
) -> None:
    """An image with its exposure and noise, stored under a pose that may be a little wrong."""
    config = street.config
    taken_ns = timestamp_ns + round((config.camera_delay_s + rig.delay_s) * 1e9)
    since_s = (timestamp_ns - street.timestamps_ns[0]) / 1e9
    gain = rig.gain * (1 + rig.gain_drift * since_s)
    rgb = street.render_recorded(rig.name, taken_ns).rgb.numpy() * gain
    rgb = rgb + config.sensor_noise * rng.standard_normal(rgb.shape)
    bgr = np.round(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
    stated = street.camera(rig.name, timestamp_ns)
    # turned to the left it is stored as turned to the right, in its own frame: y is down
    turn = torch.tensor([0.0, rig.yaw_error_rad, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    noise = np.repeat([config.pose_noise_rad, config.pose_noise_m], 3) * rng.standard_normal(6)
    error = rigid_from_tangent(turn) @ rigid_from_tangent(torch.from_numpy(noise))
    writer.add_image(
        ImageRecord(
            camera_name=rig.name,
            timestamp_ns=timestamp_ns,
            camera=stated.at(stated.world_from_camera @ error),
            distortion=street.distortion(rig.name),
            rolling_shutter=RollingShutter(duration_s=rig.readout_s, direction="down")
            if rig.readout_s and config.is_readout_told
            else None,
        ),
        jpeg.tobytes(),
    )


def _record_boxes(
    street: SyntheticStreet, sweep: SimulatedSweep, rng: np.random.Generator, writer: SceneWriter
) -> None:
    """Every actor's box at the time of the sweep, with the points that hit the actor."""
    config = street.config
    hits = torch.bincount(sweep.actor_index.long() + 1, minlength=street.num_actors + 1)[1:]
    for actor, num_points in zip(street.actors(sweep.timestamp_ns), hits.tolist(), strict=True):
        error = torch.zeros(6, dtype=torch.float64)
        error[2] = config.box_noise_rad * rng.standard_normal()
        error[3:5] = torch.from_numpy(config.box_noise_m * rng.standard_normal(2))
        writer.add_box(
            BoxRecord(
                actor_id=actor.actor_id,
                category=actor.category,
                timestamp_ns=sweep.timestamp_ns,
                world_from_box=actor.world_from_box @ rigid_from_tangent(error),
                size_m=actor.size_m,
                is_moving=actor.is_moving,
                num_points=num_points,
            )
        )
