"""The images that the small painter mixes, each with the pixels where it exists.

Candidates are the render, the filled LiDAR image, the warped training images, the mean of
render and warps, and blurred copies that trade detail for less noise.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import ConditionBatch
from lidarpainter_models.painter.filters import blur, masked_blur

PAINTING_INPUTS = frozenset({"render", "lidar", "warp"})
KNOWN_INPUTS = PAINTING_INPUTS | {"reference"}
"""The nearest recorded image, not carried into the view, serves comparisons alone."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Images to choose from in every pixel; `base` is the one that needs no learning."""

    names: tuple[str, ...]
    images: tuple[Float[Tensor, "batch 3 height width"], ...]
    exists: dict[str, Float[Tensor, "batch height width"]]
    """1 where a candidate may be chosen; those not named, as the base, exist everywhere."""
    base: str

    @property
    def base_image(self) -> Float[Tensor, "batch 3 height width"]:
        """The candidate that an untrained painter gives back."""
        return self.images[self.names.index(self.base)]

    def allowed(
        self, logits: Float[Tensor, "batch candidates height width"]
    ) -> Float[Tensor, "batch candidates height width"]:
        """The logits, minus infinity where a candidate does not exist."""
        allowed = logits.clone()
        for name, exists in self.exists.items():
            allowed[:, self.names.index(name)].masked_fill_(exists == 0, -torch.inf)
        return allowed

    def mixed(
        self, weights: Float[Tensor, "batch candidates height width"]
    ) -> Float[Tensor, "batch 3 height width"]:
        """The images' mean under weights that sum to one."""
        total = torch.zeros_like(self.images[0])
        for weight, image in zip(weights.split(1, dim=1), self.images, strict=True):
            total.addcmul_(weight, image)
        return total


def check_inputs(inputs: Iterable[str]) -> frozenset[str]:
    """The inputs a painter may see, as a set.

    Raises:
        ConfigError: an unknown input, or warps without the render that fills their gaps.
    """
    chosen = frozenset(inputs)
    if chosen - KNOWN_INPUTS:
        raise ConfigError(f"inputs must be of {sorted(KNOWN_INPUTS)}, got {sorted(chosen)}")
    if not chosen & {"render", "lidar"} or ("warp" in chosen and "render" not in chosen):
        raise ConfigError(
            f"inputs need the render or the LiDAR, and warps the render, got {sorted(chosen)}"
        )
    return chosen


def candidate_names(inputs: frozenset[str], num_sources: int) -> tuple[str, ...]:
    """The candidates a painter with these inputs has, in channel order."""
    names: list[str] = []
    if "render" in inputs:
        names += ["render", "render_blurred"]
    if "lidar" in inputs:
        names += ["lidar_filled", "lidar_blurred"]
    if "warp" in inputs:
        names += [f"warp_{source + 1}" for source in range(num_sources)]
        names += ["mean", "warp_1_blurred"]
    if "reference" in inputs:
        names.append("reference")
    return tuple(names)


def base_candidate(inputs: frozenset[str]) -> str:
    """The candidate that exists everywhere and is right without learning."""
    if "warp" in inputs:
        return "mean"
    return "render" if "render" in inputs else "lidar_filled"


def build_candidates(
    conditions: ConditionBatch,
    inputs: frozenset[str],
    lidar_filled: Float[Tensor, "batch 3 height width"],
) -> Candidates:
    """Every candidate image of a batch, in the order of `candidate_names`."""
    num_sources = conditions.warp.shape[1]
    made: dict[str, Tensor] = {}
    exists: dict[str, Tensor] = {}
    everywhere = torch.ones_like(conditions.render[:, 0])
    if "render" in inputs:
        made["render"] = conditions.render
        made["render_blurred"] = blur(conditions.render)
    if "lidar" in inputs:
        some = conditions.lidar_hit.amax(dim=(1, 2, 3))[:, None, None] * everywhere
        made["lidar_filled"], exists["lidar_filled"] = lidar_filled, some
        made["lidar_blurred"], exists["lidar_blurred"] = blur(lidar_filled), some
    if "warp" in inputs:
        for source in range(num_sources):
            made[f"warp_{source + 1}"] = conditions.warp[:, source]
            exists[f"warp_{source + 1}"] = conditions.warp_valid[:, source]
        valid = conditions.warp_valid
        total = conditions.render + (conditions.warp * valid[:, :, None]).sum(dim=1)
        made["mean"] = total / (1 + valid.sum(dim=1, keepdim=True))
        made["warp_1_blurred"] = masked_blur(conditions.warp[:, 0], conditions.warp_valid[:, :1])
        exists["warp_1_blurred"] = conditions.warp_valid[:, 0]
    if "reference" in inputs:
        made["reference"] = given_reference(conditions)
    base = base_candidate(inputs)
    exists.pop(base, None)
    return Candidates(names=tuple(made), images=tuple(made.values()), exists=exists, base=base)


def given_reference(conditions: ConditionBatch) -> Float[Tensor, "batch 3 height width"]:
    """The nearest recorded images.

    Raises:
        ConfigError: not all views have one.
    """
    if conditions.reference is None:
        raise ConfigError(
            "this painter sees the nearest recorded image, and a view has none: pairs harvested "
            "before it was gathered lack it"
        )
    return conditions.reference


def with_flat_colour(
    candidates: Candidates, name: str, rgb: Float[Tensor, "batch 3"], exists: Bool[Tensor, " batch"]
) -> Candidates:
    """One more candidate: a colour of its own for every view, or none for views without."""
    flat = rgb[..., None, None].expand_as(candidates.base_image)
    somewhere = torch.ones_like(flat[:, 0]) * exists[:, None, None]
    return replace(
        candidates,
        names=(*candidates.names, name),
        images=(*candidates.images, flat),
        exists=candidates.exists | {name: somewhere},
    )
