"""One fitted scene that answers requests: an image, and how far it can be trusted.

A pinhole is drawn the ordinary way; other lenses are put together from pinholes (`lens_images`).
What a request has as it was recorded, up to the rounding of its message, is drawn exactly as it was
recorded: so a recorded pose gives the image of `render`, bit for bit.
World: x forward, y left, z up, from where the recording began; metres.
"""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.followed_paths import found_camera
from lidarpainter_models.conditioning.view_evidence import EVIDENCE_WIDTH_PX, EvidenceGatherer
from lidarpainter_models.evaluation.view_confidence import Calibration
from lidarpainter_models.gaussians.lidar_returns.channel import LidarChannel
from lidarpainter_models.gaussians.model.actors import PRESENCE_MARGIN_NS
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.rolling_shutter import body_rates
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.kernels.side_by_side import both
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.observations.image_shrinking import fit_camera
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView, ViewKey
from lidarpainter_models.serving.lens_images import Face, LensImage, ReadByLens, reading_times
from lidarpainter_models.serving.lens_models import SensorCamera
from lidarpainter_models.serving.messages import SensorRequest, TimedRequest
from lidarpainter_models.serving.painted_streams import PaintedStreams
from lidarpainter_models.serving.placed_actors import (
    Moment,
    ParkedActors,
    placed_actors,
    reads_alike,
    same_lens,
    same_pose,
    twists_of,
)
from lidarpainter_models.serving.refusals import RequestError, invalid
from lidarpainter_models.serving.trust import EnvelopeDistance, Trust

SAME_TIME_NS = 1_500
"""Up to which a request is of a recorded moment: messages count in microseconds."""
MOST_RAYS = 2**24
"""Of lenses that are kept: of a rig of six cameras at 1920 x 1080."""
LEAST_PX = 8
"""A side of the image that trust is measured on: of one pixel there is nothing to compare."""
MIDDLE_TANGENT = 1.4
"""Of the part of a wide lens that its trust is measured on: 109 degrees across."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """What a request is answered with."""

    rgb_u8: UInt8[np.ndarray, "height width 3"]
    trust: Trust


@dataclass(frozen=True, kw_only=True, eq=False)
class ServedScene:
    """A fitted scene and all that is known of it; requests may come from several threads."""

    scene_id: str
    recorded: DrivingScene
    builder: ConditionBuilder
    """The fitted scene, and what is known of its views."""
    observation: ObservationConfig
    calibration: Calibration
    envelope: Mapping[str, Any] | None = None
    is_measured: bool = True
    """Whether the confidence of frames is measured, which takes longer than to draw them."""
    streams: PaintedStreams | None = None
    """Paints images; None shows the scene as it is."""
    returns: LidarChannel | None = None
    """What the log's LiDAR sees of the scene; None answers no sweeps."""
    _lenses: OrderedDict[SensorCamera, LensImage] = field(default_factory=OrderedDict, init=False)
    _views: dict[str, tuple[tuple[RecordedView, ...], Tensor]] = field(
        default_factory=dict, init=False
    )
    _found: dict[ViewKey, Camera] = field(default_factory=dict, init=False)
    _distances: dict[str, EnvelopeDistance] = field(default_factory=dict, init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    @property
    def scene(self) -> GaussianScene:
        """The fitted scene."""
        return self.builder.scene

    @cached_property
    def time_range_us(self) -> tuple[int, int]:
        """Times [first, last) that can be asked for: half a frame beyond what was recorded."""
        times_ns = [view.timestamp_ns for view in self.recorded.views]
        times_ns += self.recorded.frame_timestamps_ns.tolist()
        first_ns, last_ns = min(times_ns) - PRESENCE_MARGIN_NS, max(times_ns) + PRESENCE_MARGIN_NS
        return max(first_ns // 1000, 0), last_ns // 1000

    @cached_property
    def parked(self) -> ParkedActors:
        """Recorded actors that are part of the street."""
        moving = {track.actor_id for track in self.scene.actors.recorded_tracks}
        tracks = {track.actor_id: track for track in self.recorded.tracks}
        return ParkedActors({name: tracks[name] for name in tracks if name not in moving})

    @cached_property
    def evidence(self) -> EvidenceGatherer | None:
        """Measures what speaks for a view; None in a style, which has no true images."""
        if not self.is_measured or self.scene.style is not None:
            return None
        builder = self.builder
        return EvidenceGatherer(self.scene, builder.lidar_map, builder.training_views)

    def showing(self, scene: GaussianScene) -> "ServedScene":
        """The same scene changed: what is known of its log, and what was found out, is kept."""
        boxes = MovingBoxes(scene.tracks)
        other = replace(self, builder=self.builder.showing(scene, boxes))
        kept = ("_lenses", "_views", "_found", "_distances", "_lock")
        other.__dict__.update({name: getattr(self, name) for name in kept})
        if self.evidence is not None:
            other.__dict__["evidence"] = self.evidence.showing(scene)
        return other

    def frame(self, request: SensorRequest, client: str = "") -> Frame:
        """The image that a request asks for.

        Args:
            request: what is asked for.
            client: who asks; frames of one client and camera are painted in agreement.

        Raises:
            RequestError: OUT_OF_RANGE: the scene knows nothing of that time; INVALID_ARGUMENT: it
                has no such actor or camera.
        """
        moment = self._moment(request)
        painter = None
        if self.streams is not None:
            painter = self.streams.painter(moment, self.builder, client)
        image = partial(self._image, request, moment, painter)
        if self.evidence is None:  # trust costs nothing then, and the image takes all threads
            rgb, trust = image(), self.trust(request, moment)
        else:
            rgb, trust = both(image, partial(self.trust, request, moment), self.scene.device)
        if request.own_body_of is not None:
            rgb = torch.where(self._own_body(request)[..., None], 0.0, rgb)
        rgb_u8 = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        return Frame(rgb_u8=rgb_u8, trust=trust)

    def trust(self, request: SensorRequest, moment: Moment | None = None) -> Trust:
        """How far the image of a request can be trusted, before anybody paints it."""
        moment = self._moment(request) if moment is None else moment
        distance_m = None
        if self.envelope is not None:
            distance_m = self._distance(request.camera_name).of(moment.world_from_camera)
        if self.evidence is None:
            return Trust(distance_m=distance_m)
        evidence = self.evidence
        if moment.scene is not self.scene:
            evidence = evidence.showing(moment.scene)
        camera = self._looked_at(request, moment)
        found = self.calibration.of(evidence.of(camera, moment.timestamp_ns, moment.camera_name))
        return Trust(
            confidence=found.confidence, predicted_db=found.predicted_db, distance_m=distance_m
        )

    def found(self, view: RecordedView) -> Camera:
        """A recorded view's camera where the fit found it, at recorded size.

        It is kept: every client asks for recorded moments again and again.
        """
        if view.key not in self._found:
            self._found[view.key] = found_camera(self.scene, self.recorded, view, view.camera)
        return self._found[view.key]

    def refuse_other_times(self, request: TimedRequest) -> None:
        """Refuse a span of time of which the scene knows nothing.

        Raises:
            RequestError: OUT_OF_RANGE.
        """
        first_us, last_us = self.time_range_us
        if request.start_us < first_us or request.end_us > last_us:
            raise RequestError(
                "OUT_OF_RANGE",
                f"frame_start_us {request.start_us} to frame_end_us {request.end_us}: scene "
                f"{self.scene_id} was recorded from {first_us} to {last_us} us",
            )

    def _moment(self, request: SensorRequest) -> Moment:
        self.refuse_other_times(request)
        middle, shutter = request.world_from_middle, None
        if request.readout_s:
            twist = twists_of(request.world_from_sensor[None], request.readout_s)[0]
            shutter = Shutter(across_s=request.across_s, twist_per_s=twist)
        taken_ns = timestamp_ns = request.middle_ns
        found = self._recorded_as(request, middle)
        if found is not None:
            view, camera = found
            timestamp_ns, taken_ns = view.timestamp_ns, camera.taken_ns(view.timestamp_ns)
            middle, shutter = camera.world_from_camera, camera.shutter
        own = self.scene.actors
        actors = placed_actors(own, self.parked, request, taken_ns)
        return Moment(
            scene=self.scene if actors is own else self.scene.with_actors(actors),
            camera_name=request.camera_name,
            taken_ns=taken_ns,
            timestamp_ns=timestamp_ns,
            recorded=None if found is None else found[1],
            world_from_camera=middle,
            shutter=shutter,
        )

    def _recorded_as(
        self, request: SensorRequest, middle: Float[Tensor, "4 4"]
    ) -> tuple[RecordedView, Camera] | None:
        """The recorded view that a request is of, and its camera at the size asked for."""
        if request.camera_name not in self.recorded.camera_names:
            return None
        views, times_ns = self._views_of(request.camera_name)
        view = views[int((times_ns - request.middle_ns).abs().argmin())]
        if abs(view.timestamp_ns - request.middle_ns) > SAME_TIME_NS:
            return None
        camera = self.found(view).resized(
            width_px=request.camera.width_px, height_px=request.camera.height_px
        )
        if not bool(same_pose(middle, camera.world_from_camera.double())):
            return None
        return (view, camera) if reads_alike(request, camera) else None

    def _views_of(self, name: str) -> tuple[tuple[RecordedView, ...], Int[Tensor, " views"]]:
        """The recorded views of a camera, and when they were taken."""
        if name not in self._views:
            views = self.recorded.views_of(name)
            self._views[name] = (views, torch.tensor([view.timestamp_ns for view in views]))
        return self._views[name]

    def _image(
        self,
        request: SensorRequest,
        moment: Moment,
        painter: Any,  # noqa: ANN401
    ) -> Float[Tensor, "height width 3"]:
        pinhole = request.camera.pinhole_at(moment.world_from_camera)
        if pinhole is not None:
            camera = replace(pinhole, shutter=moment.shutter)
            if moment.recorded is not None and same_lens(camera, moment.recorded):
                camera = moment.recorded
            if painter is not None:
                return painter("", camera)
            drawn = moment.scene.drawable(camera, moment.timestamp_ns)
            return drawn.render(camera_name=moment.camera_name).rgb
        lens = self.lens(request.camera)
        if painter is not None:
            return lens.drawn(lambda face: painter(face.name, face.at(moment.world_from_camera)))
        return lens.drawn(self._faces(request.camera, moment))

    def _faces(self, camera: SensorCamera, moment: Moment) -> Any:  # noqa: ANN401  a function
        """What draws a face of a lens at a moment."""
        scene, shutter = moment.scene, moment.shutter
        rates = None
        if shutter is not None and shutter.is_rolling:
            standing = Camera.centred(moment.world_from_camera, 1.0, width_px=1, height_px=1)
            rates = body_rates(standing, shutter, scene.actors, moment.taken_ns)

        def draw(face: Face) -> Float[Tensor, "height width 3"]:
            posed = scene.posed(face.at(moment.world_from_camera), moment.taken_ns)
            if rates is not None and shutter is not None:
                read_s = reading_times(camera, shutter.across_s, face.camera_from_face)
                posed = ReadByLens.of_face(posed, rates, shutter, read_s)
            return scene.drawable_of(posed).render(camera_name=moment.camera_name).rgb

        return draw

    def lens(self, camera: SensorCamera) -> LensImage:
        """How the image of a lens is put together; found once."""
        with self._lock:
            if camera not in self._lenses:
                self._lenses[camera] = LensImage.of(camera, self._fitted_px)
                kept = self._lenses.values()
                while len(kept) > 1 and sum(one.is_seen.numel() for one in kept) > MOST_RAYS:
                    self._lenses.popitem(last=False)
            self._lenses.move_to_end(camera)
            return self._lenses[camera]

    @cached_property
    def _fitted_px(self) -> float:
        """Focal length of the images that the scene was fitted to: the middle one of all views."""
        return float(np.median([view.camera.fx_px for view in self.builder.training_views]))

    def _looked_at(self, request: SensorRequest, moment: Moment) -> Camera:
        """A pinhole that sees what an image shows, or the middle part of it.

        Straight ahead and narrow, where the image shows nothing ahead.
        """
        pinhole = request.camera.pinhole_at(moment.world_from_camera)
        if pinhole is not None:
            camera = moment.recorded or replace(pinhole, shutter=moment.shutter)
            size = {"width_px": camera.width_px, "height_px": camera.height_px}
            return camera.resized(**{name: max(px, LEAST_PX) for name, px in size.items()})
        rays = self.lens(request.camera).rays
        every = min(8, max(min(rays.shape[:2]) // 8, 1))
        rays = rays[::every, ::every].reshape(-1, 3)
        tangent = (rays[:, :2] / rays[:, 2:].clamp(min=0.1)).abs()[rays[:, 2] > 0.1]
        reach = torch.cat([torch.zeros(1, 2), tangent]).amax(dim=0).clamp(max=MIDDLE_TANGENT)
        focal_px = EVIDENCE_WIDTH_PX / 2 / max(float(reach[0]), 0.05)
        height_px = max(round(2 * focal_px * float(reach[1])), LEAST_PX)
        return Camera.centred(
            moment.world_from_camera, focal_px, width_px=EVIDENCE_WIDTH_PX, height_px=height_px
        )

    def _distance(self, camera_name: str) -> EnvelopeDistance:
        names = self.recorded.camera_names
        name = camera_name if camera_name in names else names[0]
        with self._lock:
            if name not in self._distances:
                views = self.recorded.views_of(name)
                self._distances[name] = EnvelopeDistance(self.envelope or {}, self.recorded, views)
            return self._distances[name]

    def _own_body(self, request: SensorRequest) -> Bool[Tensor, "height width"]:
        """Where a requested image shows the recording car itself."""
        name = request.own_body_of
        if name not in self.recorded.camera_names:
            raise invalid(
                f"ego_mask_id {name!r}: the scene has no such camera, it has "
                f"{', '.join(self.recorded.camera_names)}"
            )
        lens, seen = self.lens(request.camera), self.scene.cameras.own_bodies.get(name)
        if seen is None:
            return torch.zeros_like(lens.is_seen)
        camera = fit_camera(self.recorded.views_of(name)[0], self.observation)
        camera = camera.resized(width_px=seen.shape[1], height_px=seen.shape[0])
        return lens.meeting(seen, camera)
