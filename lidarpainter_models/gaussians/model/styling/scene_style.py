"""What a scene stores of its style: which, and what the place knows of lamps, windows and light.

Everything else follows from the Gaussians as they are, so an edited scene keeps its style. World:
z up, metres; light is linear, in units of display white.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.weather.mix import StyleMix, StyleShare

LampState = Literal["off", "on", "brake"]
"""Of a car: dark, headlamps and tail lamps, or these and brake lamps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LampChange:
    """What an actor's lamps do from one time to another, instead of what they did."""

    actor_id: str
    state: LampState
    first_ns: int
    last_ns: int

    def __post_init__(self) -> None:
        """Refuse a state that there is not.

        Raises:
            ConfigError: it is none.
        """
        if self.state not in get_args(LampState):
            raise ConfigError(f"lamps {self.state!r}, expected {', '.join(get_args(LampState))}")


@dataclass(frozen=True, kw_only=True, eq=False)
class StyledPlace:
    """Found once in views from all along the path; the same for every style."""

    white: Float[Tensor, ""]
    """Daylight of sunlit surfaces."""
    horizon_light: Float[Tensor, "3"]
    """Light of the clear sky, just above the horizon."""
    lamp_position: Float[Tensor, "lamps 3"]
    """Street lamps and signals."""
    lamp_rgb: Float[Tensor, "lamps 3"]
    lamp_power: Float[Tensor, " lamps"]
    """Irradiance a metre away."""
    lamp_radiance: Float[Tensor, " lamps"]
    window_centre: Float[Tensor, "windows 3"]
    """Middles of lit windows."""
    window_along: Float[Tensor, "windows 3"]
    """Level unit vectors along their sills."""
    window_half_m: Float[Tensor, "windows 2"]
    """Half the width and half the height of each window."""
    ego_times_ns: Int[Tensor, " frames"]
    """Ascending: the frames of the log."""
    ego_lamp: Float[Tensor, "frames 3"]
    """Between the headlamps of the car that recorded."""
    ego_heading: Float[Tensor, "frames 3"]
    """Level unit vectors."""

    def progress(self, timestamp_ns: int) -> float:
        """Share of the log's time that has passed."""
        first_ns, last_ns = int(self.ego_times_ns[0]), int(self.ego_times_ns[-1])
        return (timestamp_ns - first_ns) / max(last_ns - first_ns, 1)

    def to(self, device: torch.device) -> "StyledPlace":
        """The same on another device."""
        return on_device(self, device)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneStyle:
    """A style as part of a scene."""

    mix: StyleMix
    seed: int
    """Decides where puddles stand."""
    place: StyledPlace
    lamps: tuple[LampChange, ...] = ()
    """Lamps of actors that were switched; where two speak of one time the later one holds."""

    def strengths(self, timestamp_ns: int) -> dict[str, float]:
        """The strength of every style that changes anything at a time."""
        return self.mix.strengths(self.place.progress(timestamp_ns))

    def to(self, device: torch.device) -> "SceneStyle":
        """The same on another device."""
        return replace(self, place=self.place.to(device))

    def metadata(self) -> dict[str, Any]:
        """All but the tensors, as JSON types."""
        shares = [[share.prompt, share.first, share.last] for share in self.mix.shares]
        return {
            "shares": shares,
            "visibility_m": self.mix.visibility_m,
            "seed": self.seed,
            "lamps": [asdict(change) for change in self.lamps],
        }


def style_from_arrays(arrays: dict[str, Tensor], metadata: dict[str, Any]) -> SceneStyle:
    """Rebuild a stored style.

    Raises:
        KeyError, TypeError: something is missing or too much.
        ConfigError: it holds a style that there is not.
    """
    shares = tuple(
        StyleShare(prompt=str(prompt), first=float(first), last=float(last))
        for prompt, first, last in metadata["shares"]
    )
    return SceneStyle(
        mix=StyleMix(shares=shares, visibility_m=float(metadata["visibility_m"])),
        seed=int(metadata["seed"]),
        place=StyledPlace(**arrays),
        lamps=tuple(LampChange(**change) for change in metadata.get("lamps", ())),
    )
