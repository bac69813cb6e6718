"""Observations as named arrays and JSON-able metadata, so that a fit reads no dataset."""

from dataclasses import asdict, fields
from typing import Any

from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.cameras import LENS, Camera, Shutter
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.scenes.camera_faults import faults_from_records
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.scenes.stored_tracks import tracks_from_arrays, tracks_to_arrays
from lidarpainter_models.storage.tensor_files import grouped

SCHEMA = 1
_IMAGES = ("rgb_u8", "sky_mask", "lidar_depth_m")


def observations_to_arrays(
    observations: SceneObservations,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Arrays and metadata; `observations_from_arrays` is the inverse, bit for bit."""
    track_arrays, track_records = tracks_to_arrays(observations.tracks)
    arrays = {f"tracks.{name}": value for name, value in track_arrays.items()}
    lidar_map = observations.lidar_map
    actor_ids = sorted(lidar_map.actors)
    for index, part in enumerate(
        [lidar_map.street, *(lidar_map.actors[name] for name in actor_ids)]
    ):
        arrays |= {f"map.{index}.{name}": value for name, value in part.to_arrays().items()}
    arrays |= {f"path.{name}": value for name, value in observations.path.tensors().items()}
    bodies = observations.own_bodies
    arrays |= {f"own_body.{name}": body.contiguous() for name, body in bodies.items()}
    records = []
    for index, view in enumerate(observations.views):
        for name in _IMAGES:
            arrays[f"view.{index}.{name}"] = getattr(view, name).contiguous()
        if view.hidden is not None and view.hidden is not bodies.get(view.key[1]):
            arrays[f"view.{index}.hidden"] = view.hidden.contiguous()
        arrays[f"view.{index}.world_from_camera"] = view.camera.world_from_camera.contiguous()
        lens = {name: getattr(view.camera, name) for name in LENS}
        record = {"key": list(view.key), "timestamp_ns": view.timestamp_ns, "lens": lens}
        record["exposure_rgb"] = list(view.exposure_rgb)
        shutter = view.camera.shutter
        if shutter is not None:
            arrays[f"view.{index}.twist_per_s"] = shutter.twist_per_s.contiguous()
            record["shutter"] = {"across_s": list(shutter.across_s), "late_s": shutter.late_s}
        records.append(record)
    metadata = {
        "schema": SCHEMA,
        "views": records,
        "tracks": track_records,
        "map_actors": actor_ids,
        "is_estimated": observations.is_estimated,
        "faults": {name: asdict(fault) for name, fault in observations.faults.items()},
    }
    return arrays, metadata


def observations_from_arrays(
    arrays: dict[str, Tensor], metadata: dict[str, Any]
) -> SceneObservations:
    """Rebuild stored observations.

    Raises:
        SceneError: they were written by another version.
    """
    if metadata.get("schema") != SCHEMA:
        raise SceneError(
            f"stored observations have schema {metadata.get('schema')}, this version reads "
            f"{SCHEMA}: prepare them again"
        )
    groups = grouped(arrays)
    street, *actors = (
        MapPoints(
            **{column.name: arrays[f"map.{index}.{column.name}"] for column in fields(MapPoints)}
        )
        for index in range(len(metadata["map_actors"]) + 1)
    )
    bodies = groups.get("own_body", {})
    views = [
        _stored_view(arrays, index, row, bodies) for index, row in enumerate(metadata["views"])
    ]
    return SceneObservations(
        views=tuple(views),
        lidar_map=LidarMap(
            street=street, actors=dict(zip(metadata["map_actors"], actors, strict=True))
        ),
        tracks=tracks_from_arrays(groups["tracks"], metadata["tracks"]),
        path=EgoCorrections.from_tensors(groups.get("path", {})),
        faults=faults_from_records(metadata.get("faults", {})),
        own_bodies=bodies,
        is_estimated=metadata.get("is_estimated", False),
    )


def _stored_view(
    arrays: dict[str, Tensor], index: int, record: dict[str, Any], bodies: dict[str, Tensor]
) -> TrainingView:
    """One view of stored observations; what hides no more than its camera's body is stored once."""
    frame_index, camera_name = record["key"]
    images = {name: arrays[f"view.{index}.{name}"] for name in _IMAGES}
    told = record.get("shutter")
    shutter = told and Shutter(
        across_s=tuple(told["across_s"]),
        late_s=told["late_s"],
        twist_per_s=arrays[f"view.{index}.twist_per_s"],
    )
    return TrainingView(
        key=(int(frame_index), str(camera_name)),
        camera=Camera(
            world_from_camera=arrays[f"view.{index}.world_from_camera"],
            shutter=shutter,
            **record["lens"],
        ),
        timestamp_ns=record["timestamp_ns"],
        hidden=arrays.get(f"view.{index}.hidden", bodies.get(str(camera_name))),
        exposure_rgb=tuple(record.get("exposure_rgb", TrainingView.exposure_rgb)),
        **images,
    )
