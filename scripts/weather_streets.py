"""Streets in fog and rain; their exact truth stays that of a clear street."""

from dataclasses import replace

import numpy as np
import torch

from lidarpainter_models.painter.styles import StyleView, apply_style
from lidarpainter_models.scenes.records import SweepPoints
from lidarpainter_models.synthetic.lidar_sensor import BRIGHTNESS_REACH_M, FLOOR_BRIGHTNESS
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.synthetic.truth import SimulatedSweep, TrueImage
from lidarpainter_models.weather.air import extinction_per_m, rain_extinction_per_m
from lidarpainter_models.weather.mix import FOG_VISIBILITY_M
from lidarpainter_models.weather.water import RAIN_MM_PER_H


class _StyledStreet(SyntheticStreet):
    """A street in a weather: images by the style of that name, with exact depth; fewer returns."""

    prompt: str
    extinction_per_m: float

    def render_recorded(self, name: str, timestamp_ns: int) -> TrueImage:
        """What a camera sees in the weather; drops are other ones in every image."""
        clear = super().render_recorded(name, timestamp_ns)
        view = StyleView(
            rgb=clear.rgb,
            depth_m=clear.depth_m,
            sky=(clear.depth_m == 0).float(),
            camera=self.camera(name, timestamp_ns),
        )
        return replace(clear, rgb=apply_style(view, self.prompt, self._drawn(timestamp_ns, name)))

    def sweep(self, frame_index: int) -> SimulatedSweep:
        """A turn of the LiDAR through air that dims its light twice; the air itself returns none.

        How strong a return was follows from its intensity, as `returns_mask` has it.
        """
        found = super().sweep(frame_index)
        origin = found.world_from_lidar[:3, 3].float()
        range_m = (found.points.xyz_m - origin).norm(dim=1).clamp_min(1.0)
        energy = found.points.intensity / 255 + FLOOR_BRIGHTNESS
        strength = 8 * energy * (BRIGHTNESS_REACH_M / range_m) ** 2
        through = torch.exp(-2 * self.extinction_per_m * range_m)
        chance = torch.expm1(-strength * through) / torch.expm1(-strength)
        drawn = self._drawn(found.timestamp_ns, "sweep")
        is_kept = torch.rand(len(chance), generator=drawn) < chance
        names = SweepPoints.__dataclass_fields__
        points = SweepPoints(**{name: getattr(found.points, name)[is_kept] for name in names})
        labels = {name: getattr(found, name)[is_kept] for name in ("semantics", "actor_index")}
        return replace(found, points=points, **labels)

    def _drawn(self, timestamp_ns: int, what: str) -> torch.Generator:
        frame_index = self.timestamps_ns.index(timestamp_ns)
        entropy = [self.config.seed, frame_index, *what.encode()]
        seed = np.random.SeedSequence(entropy).generate_state(1)
        return torch.Generator().manual_seed(int(seed[0]))


class FoggyStreet(_StyledStreet):
    """A street in fog."""

    prompt = "foggy"
    extinction_per_m = extinction_per_m(FOG_VISIBILITY_M)


class RainyStreet(_StyledStreet):
    """A street in heavy rain."""

    prompt = "rain"
    extinction_per_m = rain_extinction_per_m(RAIN_MM_PER_H)
