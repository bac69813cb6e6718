"""How much images of a path change from frame to frame where they should not.

The previous frame is carried into the next by rendered depth, actors with their boxes; pixels that
both views show (depth agrees, or both see the sky) are compared. What changes there is flicker,
resampling, light that depends on the view, and wrong depth; the true images of a synthetic
street, compared under the same depth, say how much of it is not flicker.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import fmean
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.conditioning.warping import SourceImage, WarpTarget, warped_references
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.lidar.points_on_actors import BACKGROUND, MovingBoxes
from lidarpainter_models.metrics.images import psnr_from_error, squared_error
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.tracks import ActorTrack

TRUTH = "truth"
"""Name of the true images among those of a frame."""
RENDER = "render"
PAINTED = "painted"


@dataclass(frozen=True, kw_only=True, eq=False)
class FlickerFrame:
    """One moment of a path: several images of it, and the surfaces they show."""

    camera: Camera
    timestamp_ns: int
    depth_m: Float[Tensor, "height width"]
    """Rendered camera z, 0 = none."""
    alpha: Float[Tensor, "height width"]
    images: Mapping[str, Float[Tensor, "height width 3"]]
    """By the name of who made them, the same at every moment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlickerScores:
    """Figures of one kind of image along one path."""

    flicker: float | None
    """Mean absolute rgb difference on valid pixels; None where there are none."""
    moving_flicker: float | None
    """The same on moving actors alone."""
    valid_share: float
    """Of all pixels of all pairs of neighbours."""
    psnr: float | None
    """Mean over the frames, against the truth; None where nobody knows it."""
    num_pairs: int


@dataclass
class _ImageTally:
    difference: float = 0.0
    moving_difference: float = 0.0
    psnr: list[float] = field(default_factory=list)


class FlickerTally:
    """Counts the frames of one path in their order."""

    def __init__(self, tracks: Sequence[ActorTrack]) -> None:
        self._boxes = MovingBoxes(tracks)
        self._images: dict[str, _ImageTally] = {}
        self._previous: FlickerFrame | None = None
        self._num_pixels = self._num_valid = self._num_moving = self._num_pairs = 0

    def add(self, frame: FlickerFrame) -> None:
        """Count the next moment."""
        if not self._images:
            self._images = {name: _ImageTally() for name in frame.images}
        truth = frame.images.get(TRUTH)
        for name, rgb in frame.images.items():
            if truth is not None and name != TRUTH:
                error = float(squared_error(rgb, truth).mean())
                self._images[name].psnr.append(psnr_from_error(error))
        if self._previous is not None:
            self._compare(self._previous, frame)
        self._previous = frame

    def scores(self) -> dict[str, FlickerScores]:
        """The figures of every kind of image."""
        return {
            name: FlickerScores(
                flicker=_mean(tally.difference, self._num_valid),
                moving_flicker=_mean(tally.moving_difference, self._num_moving),
                valid_share=self._num_valid / max(self._num_pixels, 1),
                psnr=fmean(tally.psnr) if tally.psnr else None,
                num_pairs=self._num_pairs,
            )
            for name, tally in self._images.items()
        }

    def _compare(self, before: FlickerFrame, now: FlickerFrame) -> None:
        sources = [
            SourceImage(
                key=(0, name),
                camera=before.camera,
                timestamp_ns=before.timestamp_ns,
                rgb=rgb,
                depth_m=before.depth_m,
                alpha=before.alpha,
            )
            for name, rgb in before.images.items()
        ]
        target = WarpTarget.of_render(now.camera, now.timestamp_ns, now.depth_m, now.alpha)
        carried = [warped_references(target, [source], self._boxes, count=1) for source in sources]
        compared = carried[0].valid[0]  # of depth alone, so the same for all images
        moving = compared & self._on_actors(now)
        self._num_pairs += 1
        self._num_pixels += compared.numel()
        self._num_valid += int(compared.sum())
        self._num_moving += int(moving.sum())
        for warped, (name, image) in zip(carried, now.images.items(), strict=True):
            difference = (warped.rgb[0] - image).abs().mean(dim=-1).double()
            self._images[name].difference += float(difference[compared].sum())
            self._images[name].moving_difference += float(difference[moving].sum())

    def _on_actors(self, frame: FlickerFrame) -> Bool[Tensor, "height width"]:
        """Pixels whose surface lies in the box of a moving actor."""
        points_world = frame.camera.unproject(frame.depth_m).reshape(-1, 3)
        owners = self._boxes.owners(points_world, frame.timestamp_ns)
        inside = (owners != BACKGROUND).reshape(frame.depth_m.shape)
        return inside & (frame.depth_m > 0)


def _mean(total: float, count: int) -> float | None:
    return total / count if count else None


@dataclass(frozen=True, kw_only=True, eq=False)
class FlickerEvaluation:
    """How neighbouring frames of a fitted scene are compared, as rendered and as painted."""

    held_out: HeldOut
    camera_name: str
    """Whose path is shifted."""
    shifts: Sequence[Shift]
    previous: Sequence[SequenceConfig]
    """What else may become of the frame painted before."""

    def scores(
        self, painting: ViewTimePainting, progress: Callable[[int, int], None]
    ) -> dict[str, dict[str, Any]]:
        """The figures of every shift, by image."""
        found = {}
        for done, shift in enumerate(self.shifts, start=1):
            found[shift.name] = self._of_path(shift, painting)
            progress(done, len(self.shifts))
        return found

    def _of_path(self, shift: Shift, painting: ViewTimePainting) -> dict[str, Any]:
        builder, painter = painting.conditions, painting.painter.load(painting.device)
        painters = {
            _label(config): SequencePainter(
                builder, painter, config=config, camera_name=self.camera_name
            )
            for config in (SequenceConfig(), *self.previous)
        }
        tally = FlickerTally(builder.boxes.tracks)
        for view in self.held_out.scene.views_of(self.camera_name):
            tally.add(self._frame(view, shift, painting, painters))
        return {name: asdict(found) for name, found in tally.scores().items()}

    def _frame(
        self,
        view: RecordedView,
        shift: Shift,
        painting: ViewTimePainting,
        painters: dict[str, SequencePainter],
    ) -> FlickerFrame:
        builder, time_ns = painting.conditions, view.timestamp_ns
        camera = self.held_out.shifted_camera(builder.scene, view, shift)
        conditions = builder.conditions(camera, time_ns, camera_name=self.camera_name)
        images: dict[str, Float[Tensor, "height width 3"]] = {RENDER: conditions.render_rgb}
        for name, painter in painters.items():
            images[name] = painter.paint_conditions(conditions, camera, time_ns).rgb
        street = known_street(self.held_out.scene)
        if street is not None:
            truth = street.render(camera, time_ns).rgb.clamp(0, 1)
            images[TRUTH] = truth.to(conditions.render_rgb.device)
        return FlickerFrame(
            camera=camera,
            timestamp_ns=time_ns,
            depth_m=conditions.render_depth_m,
            alpha=conditions.render_alpha,
            images=images,
        )


def _label(config: SequenceConfig) -> str:
    return PAINTED if config.previous == "unused" else f"{PAINTED}, previous {config.previous}"
