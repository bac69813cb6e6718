"""Turn pairs into training batches: random windows, flips, light, styles, and things taken away.

Everything follows from one generator per step, so a batch depends on the seed and the step alone
and a resumed training sees the batches it would have seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import ConditionBatch, moved, stack_conditions
from lidarpainter_models.painter.examples import PaintingPair, PairSource, Window
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT
from lidarpainter_models.painter.render_damage import damage_render
from lidarpainter_models.painter.styles import StyleView, apply_style


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentationConfig:
    """How pairs are varied; every number ending in `_share` is a share of the samples."""

    crop_px: int = 128
    """Side of the windows; a multiple of the network's 16 px."""
    lidar_dropout_share: float = 0.2
    """Samples without any LiDAR: the painter must also serve logs and views that have none."""
    lidar_thinning_share: float = 0.2
    """Samples that keep only a random part of the LiDAR hits."""
    warp_dropout_share: float = 0.2
    """Samples without any warp, as in places no camera saw."""
    warp_swap_share: float = 0.2
    """Samples that lose the best warp only."""
    damage_share: float = 0.25
    """Samples with damage painted onto the render."""
    identity_share: float = 0.05
    """Samples whose render is already perfect: it has to stay as it is."""
    gain_range: float = 0.35
    """Largest change of the logarithm of exposure, of all images of a sample alike."""
    tint_range: float = 0.1
    """The same for each channel by itself."""
    mismatch_range: float = 0.06
    """Largest change of the logarithm of exposure of one warp or the LiDAR alone."""
    style_share: float = 0.5
    """Samples whose target is in a style, where the network has prompts for any."""

    def __post_init__(self) -> None:
        if self.crop_px < 32 or self.crop_px % 16:
            raise ConfigError(f"crop_px must be a multiple of 16 and >= 32, got {self.crop_px}")
        for name in self.__slots__:
            if name.endswith("_share") and not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be in [0, 1], got {getattr(self, name)}")


class TrainingBatch(NamedTuple):
    """What the network is shown, and what it should give."""

    conditions: ConditionBatch
    target: Float[Tensor, "batch 3 height width"]
    target_valid: Float[Tensor, "batch height width"]
    prompts: tuple[str, ...]

    @property
    def restyled(self) -> Bool[Tensor, " batch"]:
        """Samples whose target is in a style."""
        styled = [prompt != DEFAULT_PROMPT for prompt in self.prompts]
        return torch.tensor(styled, device=self.target.device)

    def to(self, device: torch.device) -> "TrainingBatch":
        """The same batch on another device; see `ConditionBatch.to`."""
        return self._replace(
            conditions=self.conditions.to(device),
            target=moved(self.target, device),
            target_valid=moved(self.target_valid, device),
        )


def draw_batch(
    sources: Sequence[PairSource],
    source_shares: Sequence[float],
    *,
    batch_size: int,
    num_warps: int,
    prompts: Sequence[str] = (DEFAULT_PROMPT,),
    config: AugmentationConfig,
    generator: Generator,
) -> TrainingBatch:
    """Draw windows from the sources, each source by its share, and vary them.

    The first prompt restores; the others are styles that targets are put into.
    """
    shares = torch.tensor(source_shares, dtype=torch.float64)
    pairs = []
    for _ in range(batch_size):
        source = sources[int(torch.multinomial(shares, 1, generator=generator))]
        index = int(torch.randint(len(source), (), generator=generator))
        window = random_window(source.size_px(index), config, generator)
        pairs.append(_read(source, index, window, prompts, config, generator))
    return augment(batch_pairs(pairs, num_warps), config, generator)


def _read(
    source: PairSource,
    index: int,
    window: Window,
    prompts: Sequence[str],
    config: AugmentationConfig,
    generator: Generator,
) -> PaintingPair:
    """A window of a pair, its target in a style that is drawn if there are any."""
    if len(prompts) == 1 or float(torch.rand((), generator=generator)) >= config.style_share:
        return source.read(index, window)
    chosen = 1 + int(torch.randint(len(prompts) - 1, (), generator=generator))
    seed = int(torch.randint(1 << 31, (), generator=generator))
    pair = styled_pair(source.read(index), prompts[chosen], Generator().manual_seed(seed))
    return pair.cropped(window)


def random_window(
    size_px: tuple[int, int], config: AugmentationConfig, generator: Generator
) -> Window:
    """A square window anywhere in an image.

    Raises:
        ConfigError: the image is smaller than the window.
    """
    side = config.crop_px
    room = (size_px[0] - side, size_px[1] - side)
    if min(room) < 0:
        raise ConfigError(f"pairs of {size_px[1]}x{size_px[0]} px are smaller than crop_px {side}")
    top, left = (int(torch.randint(free + 1, (), generator=generator)) for free in room)
    return Window(top, left, side, side)


def batch_pairs(pairs: Sequence[PaintingPair], num_warps: int) -> TrainingBatch:
    """Stack pairs of one size."""
    conditions = stack_conditions([pair.conditions for pair in pairs], num_sources=num_warps)
    target = torch.stack([pair.target_rgb.permute(2, 0, 1) for pair in pairs]).contiguous()
    valid = torch.stack([pair.target_valid.float() for pair in pairs])
    return TrainingBatch(conditions, target, valid, tuple(p.conditions.prompt for p in pairs))


def augment(
    batch: TrainingBatch, config: AugmentationConfig, generator: Generator
) -> TrainingBatch:
    """Vary a batch; masks keep meaning what they mean."""
    batch = _change_light(batch, config, generator)
    batch = _take_away(batch, config, generator)
    batch = _change_render(batch, config, generator)
    flipped = _chosen(0.5, len(batch.target), generator)
    return _flip(batch, flipped)


def _change_light(
    batch: TrainingBatch, config: AugmentationConfig, generator: Generator
) -> TrainingBatch:
    """One exposure and tint for a whole sample, and a small mismatch of warps and LiDAR."""
    size = len(batch.target)
    gain = torch.exp(config.gain_range * _signed((size, 1, 1, 1), generator))
    gain = gain * torch.exp(config.tint_range * _signed((size, 3, 1, 1), generator))
    old = batch.conditions
    num_warps = old.warp.shape[1]
    lidar_gain = torch.exp(config.mismatch_range * _signed((size, 1, 1, 1), generator))
    warp_gain = torch.exp(config.mismatch_range * _signed((size, num_warps, 1, 1, 1), generator))
    conditions = replace(
        old,
        render=(old.render * gain).clamp_max(1),
        lidar=(old.lidar * gain * lidar_gain).clamp_max(1),
        warp=(old.warp * gain[:, None] * warp_gain).clamp_max(1),
        reference=None if old.reference is None else (old.reference * gain).clamp_max(1),
    )
    return batch._replace(conditions=conditions, target=(batch.target * gain).clamp_max(1))


def _take_away(
    batch: TrainingBatch, config: AugmentationConfig, generator: Generator
) -> TrainingBatch:
    """Leave out LiDAR, part of it, the best warp or all of them."""
    size = len(batch.target)
    old = batch.conditions
    no_lidar = _chosen(config.lidar_dropout_share, size, generator)
    thinned = _chosen(config.lidar_thinning_share, size, generator)
    kept_share = torch.rand((size, 1, 1, 1), generator=generator)
    drawn = torch.rand(old.lidar_hit.shape, generator=generator)
    kept = ((drawn < kept_share) | ~thinned[:, None, None, None]).float()
    kept = kept * (~no_lidar[:, None, None, None]).float()
    no_warp = _chosen(config.warp_dropout_share, size, generator)
    swapped = _chosen(config.warp_swap_share, size, generator)
    warp, valid = old.warp.clone(), old.warp_valid.clone()
    warp[swapped], valid[swapped] = warp[swapped].roll(-1, 1), valid[swapped].roll(-1, 1)
    gone = torch.zeros_like(valid[:, :, :1, :1])
    gone[no_warp] = 1
    gone[swapped, -1] = 1
    conditions = replace(
        old,
        lidar=old.lidar * kept,
        lidar_depth_m=old.lidar_depth_m * kept,
        lidar_hit=old.lidar_hit * kept,
        warp=warp * (1 - gone)[:, :, None],
        warp_valid=valid * (1 - gone),
    )
    return batch._replace(conditions=conditions)


def _change_render(
    batch: TrainingBatch, config: AugmentationConfig, generator: Generator
) -> TrainingBatch:
    """Damage some renders and replace some by the truth."""
    size = len(batch.target)
    damaged = _chosen(config.damage_share, size, generator)
    # a styled target is no perfect render of a clear view
    perfect = _chosen(config.identity_share, size, generator) & ~batch.restyled
    render = batch.conditions.render.clone()
    for index in damaged.nonzero()[:, 0].tolist():
        render[index] = damage_render(render[index], generator)
    known = batch.target_valid[:, None] > 0
    replaced = perfect[:, None, None, None] & known
    render = torch.where(replaced, batch.target, render)
    return batch._replace(conditions=replace(batch.conditions, render=render))


def _flip(batch: TrainingBatch, flipped: Tensor) -> TrainingBatch:
    """Mirror the chosen samples left to right."""

    def turn(values: Tensor) -> Tensor:
        mirrored = values.clone()
        mirrored[flipped] = values[flipped].flip(-1)
        return mirrored

    return batch._replace(
        conditions=batch.conditions.map(turn),
        target=turn(batch.target),
        target_valid=turn(batch.target_valid),
    )


def _chosen(share: float, size: int, generator: Generator) -> Tensor:
    return torch.rand(size, generator=generator) < share


def _signed(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Uniform in [-1, 1)."""
    return 2 * torch.rand(shape, generator=generator) - 1


def styled_pair(pair: PaintingPair, prompt: str, generator: Generator) -> PaintingPair:
    """The pair with a styled target and the prompt that asks for it; whole images only.

    The conditions stay clear; the target is styled by the depth of its own view: LiDAR where it
    hit, the render elsewhere. Pairs keep no camera, so depth stands for distance, and what needs to
    know the ground (the low beam, windows, wet roads) is left out.

    Raises:
        ConfigError: there is no such style.
    """
    conditions = replace(pair.conditions, prompt=prompt)
    if prompt == DEFAULT_PROMPT:
        return replace(pair, conditions=conditions)
    target = apply_style(target_view(pair), prompt, generator)
    return replace(pair, conditions=conditions, target_rgb=target)


def target_view(pair: PaintingPair) -> StyleView:
    """The target with the depth and the sky of its view."""
    old = pair.conditions
    below_a_hit = old.lidar_hit.int().cumsum(dim=0) > 0
    return StyleView(
        rgb=pair.target_rgb,
        depth_m=torch.where(old.lidar_hit, old.lidar_depth_m, old.render_depth_m),
        # what the Gaussians leave open, above the topmost LiDAR hit of its column
        sky=torch.where(below_a_hit, 0.0, 1 - old.render_alpha.clamp(0, 1)),
    )
