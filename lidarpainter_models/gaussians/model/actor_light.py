"""How bright each actor is over time: who drives from the sun into the shade grows dark.

A body has the colours of its mean light. At a time they are multiplied, channel by channel, by a
gain that is linear in time between the knots, the training times.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.gaussians.model.bending import knots_around
from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT, GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians


@dataclass(frozen=True, eq=False, kw_only=True)
class ActorLight:
    """The gains of all actors."""

    knots_ns: Int[Tensor, " knots"]
    """Ascending; on the CPU."""
    log_gain: Float[Tensor, "knots actors 3"]
    """Natural logarithm; of each actor and channel the mean over the knots is 0. Changed in place
    by a fit."""

    @classmethod
    def steady(cls, count: int, knots_ns: Int[Tensor, " knots"]) -> "ActorLight":
        """So many actors that stay as bright as they are."""
        return cls(knots_ns=knots_ns, log_gain=torch.zeros(len(knots_ns), count, 3))

    def to(self, device: torch.device) -> "ActorLight":
        """The same for Gaussians on another device."""
        return on_device(self, device, stays=("knots_ns",))

    def with_steady(self) -> "ActorLight":
        """The same and one more, who stays as bright, as the last."""
        more = self.log_gain.new_zeros(len(self.knots_ns), 1, 3)
        return replace(self, log_gain=torch.cat([self.log_gain, more], dim=1))

    def kept(self, rows: list[int]) -> "ActorLight":
        """Some of the actors."""
        return replace(self, log_gain=self.log_gain[:, rows])

    def log_gain_at(self, timestamp_ns: int) -> Float[Tensor, "actors 3"]:
        """The gains at a time, before and after all knots those of the nearest; differentiable."""
        before, after, weight = knots_around(self.knots_ns, timestamp_ns)
        return (1 - weight) * self.log_gain[before] + weight * self.log_gain[after]

    def lit(self, gaussians: AnyGaussians, timestamp_ns: int) -> AnyGaussians:
        """The Gaussians as bright as their bodies are at a time; differentiable in both."""
        if not self.log_gain.shape[1]:
            return gaussians
        of_actors = self.log_gain_at(timestamp_ns).exp()
        of_bodies = torch.cat([torch.ones_like(of_actors[:1]), of_actors])
        gain = of_bodies[gaussians.body_index.long()][:, None]
        # a colour is half a unit brighter than its constant harmonic says
        more = (gain - 1) * (0.5 / SH_CONSTANT)
        if isinstance(gaussians, GaussianSet):
            shown = {"sh_dc": gaussians.sh_dc * gain + more, "sh_rest": gaussians.sh_rest * gain}
        else:
            sh = gaussians.sh * gain
            shown = {"sh": torch.cat([sh[:, :1] + more, sh[:, 1:]], dim=1)}
        return replace(gaussians, **shown)
