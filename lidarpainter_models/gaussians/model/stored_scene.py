"""A Gaussian scene as arrays and JSON-able metadata, and back bit for bit."""

from dataclasses import asdict
from typing import Any

from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.gaussians.model.actor_light import ActorLight
from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.bending import Bending
from lidarpainter_models.gaussians.model.blinking import Blinking
from lidarpainter_models.gaussians.model.corrections import CameraCorrections, ExposureCorrections
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.styling.scene_style import style_from_arrays
from lidarpainter_models.kernels.sky_texture import SkyLayout, TexelMoments
from lidarpainter_models.scenes.camera_faults import faults_from_records
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.scenes.stored_tracks import tracks_from_arrays, tracks_to_arrays
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.storage.tensor_files import grouped

SCHEMA = 1


def scene_to_arrays(scene: GaussianScene) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Arrays and metadata of the whole scene; `scene_from_arrays` inverts it bitwise."""
    track_arrays, track_records = tracks_to_arrays(scene.actors.recorded_tracks)
    sky, cameras = scene.sky, scene.cameras
    groups: dict[str, dict[str, Tensor]] = {
        "gaussians": scene.gaussians.columns(),
        "sky": {
            "rgb": sky.rgb,
            "weight": sky.weight,
            "first_moment": sky.moments.first,
            "second_moment": sky.moments.second,
            "visits": sky.moments.visits,
        },
        "tracks": track_arrays,
        "cameras": cameras.tensors(),
        "path": cameras.path.tensors(),
        "own_body": dict(cameras.own_bodies),
        "actors": {"knots_ns": scene.actors.knots_ns, "tangent": scene.actors.tangent},
        "bending": vars(scene.actors.bending),
        "actor_light": {"log_gain": scene.actors.light.log_gain},
        "blinking": vars(scene.blinking),
        "exposure": {
            "matrix": scene.exposure.matrix,
            "knots_ns": scene.exposure.knots_ns,
            "log_gain": scene.exposure.log_gain,
        },
        "style": {} if scene.style is None else vars(scene.style.place),
    }
    arrays = {
        f"{group}.{name}": value.detach().cpu().contiguous()
        for group, columns in groups.items()
        for name, value in columns.items()
    }
    metadata = {
        "schema": SCHEMA,
        "tracks": track_records,
        "view_keys": [list(key) for key in cameras.keys],
        "camera_names": list(cameras.camera_names),
        "camera_faults": {name: asdict(fault) for name, fault in cameras.faults.items()},
        "exposure_camera_names": list(scene.exposure.camera_names),
        "sky_layout": asdict(sky.layout),
    }
    if scene.style is not None:
        metadata["style"] = scene.style.metadata()
    return arrays, metadata


def scene_from_arrays(arrays: dict[str, Tensor], metadata: dict[str, Any]) -> GaussianScene:
    """Rebuild a stored scene.

    Raises:
        SceneError: the arrays were written by another version or are incomplete.
    """
    if metadata.get("schema") != SCHEMA:
        raise SceneError(
            f"a stored Gaussian scene has schema {metadata.get('schema')}, this version reads "
            f"{SCHEMA}: fit it again"
        )
    groups = grouped(arrays)
    try:
        return GaussianScene(
            gaussians=GaussianSet(**groups["gaussians"]),
            actors=_actors(groups, tracks_from_arrays(groups["tracks"], metadata["tracks"])),
            sky=_sky(groups["sky"], SkyLayout(**metadata["sky_layout"])),
            cameras=CameraCorrections(
                keys=tuple((int(frame), str(name)) for frame, name in metadata["view_keys"]),
                camera_names=tuple(metadata["camera_names"]),
                faults=faults_from_records(metadata.get("camera_faults", {})),
                own_bodies=groups.get("own_body", {}),
                path=EgoCorrections.from_tensors(groups.get("path", {})),
                **groups["cameras"],
            ),
            exposure=_exposure(groups["exposure"], metadata["exposure_camera_names"]),
            blinking=Blinking(**groups["blinking"]) if "blinking" in groups else Blinking.none(),
            style=style_from_arrays(groups["style"], metadata["style"])
            if "style" in metadata
            else None,
        )
    except (KeyError, TypeError) as error:
        raise SceneError(f"a stored Gaussian scene is incomplete: {error}") from error


def copy_scene(scene: GaussianScene) -> GaussianScene:
    """The same scene, sharing no memory and collecting no gradients."""
    arrays, metadata = scene_to_arrays(scene)
    copied = scene_from_arrays({name: value.clone() for name, value in arrays.items()}, metadata)
    return copied.to(scene.device)


def _exposure(arrays: dict[str, Tensor], camera_names: list[str]) -> ExposureCorrections:
    """Scenes stored before there were gains have none."""
    unknown = ExposureCorrections.none(camera_names, [0])
    return ExposureCorrections(
        camera_names=tuple(camera_names),
        matrix=arrays["matrix"],
        knots_ns=arrays.get("knots_ns", unknown.knots_ns),
        log_gain=arrays.get("log_gain", unknown.log_gain),
    )


def _sky(arrays: dict[str, Tensor], layout: SkyLayout) -> SkyTexture:
    return SkyTexture(
        layout=layout,
        rgb=arrays["rgb"],
        weight=arrays["weight"],
        moments=TexelMoments(
            first=arrays["first_moment"], second=arrays["second_moment"], visits=arrays["visits"]
        ),
    )


def _actors(groups: dict[str, dict[str, Tensor]], tracks: tuple[ActorTrack, ...]) -> Actors:
    """Actors; those of earlier software neither bend nor change their light."""
    knots_ns = groups["actors"]["knots_ns"]
    if "actor_light" in groups:
        light = ActorLight(knots_ns=knots_ns, **groups["actor_light"])
    else:
        light = ActorLight.steady(len(tracks), knots_ns)
    bending = Bending(**groups["bending"]) if "bending" in groups else Bending.none()
    return Actors(recorded_tracks=tracks, bending=bending, light=light, **groups["actors"])
