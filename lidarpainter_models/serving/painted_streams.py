"""Painted images of simulators: each camera's frames in agreement with the one before.

A stream is what one client asks of one camera. It begins anew when time does not go on, when it
jumps by more than `LONGEST_GAP_NS`, and when others have pushed it out.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from threading import Lock

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.sequences import SequencePainter
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.protocol import Painter
from lidarpainter_models.serving.placed_actors import Moment

LONGEST_GAP_NS = 500_000_000
MOST_STREAMS = 64
"""Of one scene; the one that was asked longest ago is forgotten."""


@dataclass(eq=False)
class _Stream:
    painter: SequencePainter
    taken_ns: int


@dataclass(eq=False, kw_only=True)
class PaintedStreams:
    """The streams of one scene."""

    painter_of_scene: Painter
    _streams: OrderedDict[tuple[str, ...], _Stream] = field(default_factory=OrderedDict)
    _lock: Lock = field(default_factory=Lock)

    def painter(
        self, moment: Moment, builder: ConditionBuilder, client: str
    ) -> Callable[[str, Camera], Float[Tensor, "height width 3"]]:
        """What paints one image of a moment: a function of a face's name and its camera."""
        shown = builder
        if moment.scene is not builder.scene:
            poses, is_there = moment.scene.actors.refined_poses(moment.taken_ns)
            boxes = builder.boxes.standing(moment.taken_ns, poses, is_there > 0)
            shown = builder.showing(moment.scene, boxes)
        return partial(self._paint, moment, shown, client)

    def _paint(
        self, moment: Moment, builder: ConditionBuilder, client: str, face: str, camera: Camera
    ) -> Float[Tensor, "height width 3"]:
        conditions = builder.conditions(camera, moment.timestamp_ns, camera_name=moment.camera_name)
        with self._lock:  # frames of a stream lean on each other, and the painter has all threads
            stream = self._stream((client, moment.camera_name, face), moment, builder)
            painted = stream.painter.paint_conditions(conditions, camera, moment.timestamp_ns)
            stream.taken_ns = moment.taken_ns
        return painted.rgb.clamp(0, 1)

    def _stream(self, key: tuple[str, ...], moment: Moment, builder: ConditionBuilder) -> _Stream:
        known = self._streams.pop(key, None)
        if known is None or not 0 < moment.taken_ns - known.taken_ns <= LONGEST_GAP_NS:
            painter = SequencePainter(
                builder,
                self.painter_of_scene,
                config=SequenceConfig(previous="mixed"),
                camera_name=moment.camera_name,
            )
            known = _Stream(painter, moment.taken_ns)
        self._streams[key] = known
        while len(self._streams) > MOST_STREAMS:
            self._streams.popitem(last=False)
        return known
