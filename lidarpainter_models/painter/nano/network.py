"""The small fusion network: chooses, per pixel, among images that already exist.

A residual U-Net (Ronneberger et al., 2015) at a quarter of the resolution gives a softmax over the
candidate images of `candidates.py`, a bounded residual, and the log of the error it expects.
Because colours come from the inputs it cannot invent much; at first it returns the base candidate
(the mean of render and warps), so training only departs from it where that pays.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import ConditionBatch
from lidarpainter_models.painter.nano.candidates import (
    PAINTING_INPUTS,
    Candidates,
    base_candidate,
    build_candidates,
    candidate_names,
    check_inputs,
    with_flat_colour,
)
from lidarpainter_models.painter.nano.features import count_features, painting_features
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT

CELL_PX = 4
"""Side of the pixel block that one position of the network stands for."""
TINT = "tint"
"""The candidate that is no image but a flat colour, learnt for each style."""
STYLE_PACE = 10.0
"""Factor of what is learnt for each style: it has to go far while the rest of a trained network
stays close to what it knows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NanoConfig:
    """The shape of the small painter."""

    inputs: frozenset[str] = PAINTING_INPUTS
    """What it may see and mix: `render`, `lidar`, `warp`; fewer for ablations, and `reference`, the
    nearest recorded image as it was taken."""
    composite: bool = False
    """Show the render where no LiDAR point hits, in place of the points' own colours spread
    there; an ablation."""
    mix: bool = True
    """Mix candidates by a softmax. Without it the image itself is predicted, each colour by a
    sigmoid; an ablation."""
    skips: bool = True
    """Add what each level saw on the way down to what comes up; off in an ablation."""
    widths: tuple[int, int, int] = (48, 96, 160)
    """Channels at 1/4, 1/8 and 1/16 of the resolution."""
    blocks: tuple[int, int, int] = (2, 2, 3)
    """Residual blocks per level; the upper two have as many again on the way up."""
    normalise: bool = True
    """Keep activations at one size. Without it a training at this learning rate can run away and
    leave a network that says the same everywhere; off in weights made before."""
    num_sources: int = 2
    """Warped images it looks at; missing ones count as invalid, further ones are left out."""
    residual_limit: float = 0.25
    """Largest change beyond the mix, in units of rgb: enough for a glint, too little to paint."""
    base_logit: float = 2.5
    """First logit of the base candidate: high enough to begin near it, low enough for the other
    candidates to be learnt from (at 9 they hardly were)."""
    confidence_error: float = 0.05
    """Mean absolute error at which the confidence has fallen to 1/e."""
    prompts: tuple[str, ...] = (DEFAULT_PROMPT,)
    """Prompts the network was trained for, each with its own embedding. Those after the first are
    styles, and may mix in a flat colour of their own: the white of fog, the black of night."""

    def __post_init__(self) -> None:
        check_inputs(self.inputs)
        counts = (*self.widths, *self.blocks, self.num_sources, len(self.prompts))
        if len(self.widths) != 3 or len(self.blocks) != 3 or min(counts) < 1:
            raise ConfigError(
                "nano needs three positive widths and blocks, a source and a prompt, got "
                f"{self.widths}, {self.blocks}, {self.num_sources}, {self.prompts}"
            )
        if self.composite and not {"render", "lidar"} <= self.inputs:
            raise ConfigError(f"a composite is of render and LiDAR, got {sorted(self.inputs)}")
        if not self.mix and len(self.prompts) > 1:
            raise ConfigError("styles are learnt as a candidate of the mix: prompts need mix")

    @property
    def candidates(self) -> tuple[str, ...]:
        """The images it mixes, in channel order."""
        names = candidate_names(self.inputs, self.num_sources)
        return (*names, TINT) if len(self.prompts) > 1 else names

    @property
    def num_outputs(self) -> int:
        """Logits of the candidates, three colours, and the expected error."""
        return len(self.candidates) * self.mix + 4

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return asdict(self) | {"inputs": sorted(self.inputs)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "NanoConfig":
        """Undo `to_dict`.

        Raises:
            ConfigError: a field is missing, unknown or of the wrong type.
        """
        try:
            changed = {key: tuple(values[key]) for key in ("widths", "blocks", "prompts")}
            inputs = frozenset(values["inputs"])
            return cls(**{"normalise": False} | values | changed | {"inputs": inputs})
        except (KeyError, TypeError) as error:
            raise ConfigError(f"not the settings of a nano painter: {error}") from None


@dataclass(frozen=True, kw_only=True, eq=False)
class NanoOutput:
    """What the network says about a batch of views."""

    rgb: Float[Tensor, "batch 3 height width"]
    """Not clamped, so that gradients pass."""
    base: Float[Tensor, "batch 3 height width"]
    """The base candidate, for comparison."""
    log_error: Float[Tensor, "batch height width"]
    """Logarithm of the mean absolute error it expects."""
    weights: Float[Tensor, "batch candidates height width"]
    """Shares of the candidates; they sum to one. Of no candidate where nothing is mixed."""


class Style(NamedTuple):
    """What a prompt adds to the network; all zero changes nothing."""

    colour: Float[Tensor, "batch 3"]
    """Of the tint, before the sigmoid that makes it rgb."""
    logits: Float[Tensor, "batch candidates"]
    """Added to those of the candidates everywhere."""
    gain: Float[Tensor, "batch channels"]
    shift: Float[Tensor, "batch channels"]
    """Of the features before the head, as in FiLM (Perez et al., 2018)."""


class PixelNorm(nn.Module):
    """Scales the channels of every pixel to a root mean square of one (Zhang and Sennrich, 2019).

    It looks at one pixel alone, so a window and a whole image are treated alike.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise and scale."""
        pixels = F.rms_norm(x.permute(0, 2, 3, 1), self.gain.shape, self.gain.to(x.dtype), 1e-4)
        return pixels.permute(0, 3, 1, 2)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside an identity; starts as the identity."""

    def __init__(self, width: int, *, normalise: bool) -> None:
        super().__init__()
        self.before = PixelNorm(width) if normalise else nn.SiLU()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        """Add the block's change to its input."""
        return x + self.second(F.silu(self.first(self.before(x))))


def residual_blocks(width: int, number: int, *, normalise: bool) -> nn.Sequential:
    """So many blocks, one after the other."""
    return nn.Sequential(*(ResidualBlock(width, normalise=normalise) for _ in range(number)))


class NanoNetwork(nn.Module):
    """The fusion network of one `NanoConfig`; deterministic, free of normalisation by image."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        self.config = config
        fine, middle, coarse = config.widths
        in_channels = count_features(config.inputs, config.num_sources) * CELL_PX**2
        self.stem = nn.Conv2d(in_channels, fine, 3, padding=1)
        self.encode_fine = residual_blocks(fine, config.blocks[0], normalise=config.normalise)
        self.down_middle = nn.Conv2d(fine, middle, 2, stride=2)
        self.encode_middle = residual_blocks(middle, config.blocks[1], normalise=config.normalise)
        self.down_coarse = nn.Conv2d(middle, coarse, 2, stride=2)
        self.encode_coarse = residual_blocks(coarse, config.blocks[2], normalise=config.normalise)
        self.prompt = nn.Embedding(len(config.prompts), coarse)
        self.up_middle = nn.Conv2d(coarse, middle * 4, 1)
        self.decode_middle = residual_blocks(middle, config.blocks[1], normalise=config.normalise)
        self.up_fine = nn.Conv2d(middle, fine * 4, 1)
        self.decode_fine = residual_blocks(fine, config.blocks[0], normalise=config.normalise)
        self.last = PixelNorm(fine) if config.normalise else nn.Identity()
        self.head = nn.Conv2d(fine, config.num_outputs * CELL_PX**2, 3, padding=1)
        if TINT in config.candidates:
            # colour of the tint, logits of the candidates, gain and shift of the last features
            self.style = nn.Embedding(len(config.prompts), 3 + len(config.candidates) + 2 * fine)
            nn.init.zeros_(self.style.weight)
        self._start_as_base()

    @torch.no_grad()
    def _start_as_base(self) -> None:
        """Zero the head; its biases choose the base candidate and expect an error of 0.03."""
        for parameter in (*self.head.parameters(), self.prompt.weight):
            nn.init.zeros_(parameter)
        bias = self.head.get_parameter("bias").view(-1, CELL_PX**2)
        if self.config.mix:
            base = self.config.candidates.index(base_candidate(self.config.inputs))
            bias[base] = self.config.base_logit
        bias[-1] = -3.5

    def prompt_index(self, prompt: str) -> int:
        """Row of a prompt's embedding.

        Raises:
            ConfigError: the network was not trained for this prompt.
        """
        if prompt not in self.config.prompts:
            known = ", ".join(self.config.prompts)
            raise ConfigError(f"the nano painter knows no prompt {prompt!r}, only: {known}")
        return self.config.prompts.index(prompt)

    def halved(self) -> "NanoNetwork":
        """A copy whose U-Net lies in bfloat16: nothing is converted while it runs.

        Training needs float32 weights and converts them in every step (`half_precision`).
        """
        halved = deepcopy(self)
        for name, module in halved.named_children():
            if name != "style":  # its colour is an image's
                module.to(torch.bfloat16)
        return halved

    def forward(
        self, conditions: ConditionBatch, prompts: Sequence[str], *, half_precision: bool = False
    ) -> NanoOutput:
        """Mix the candidates of every view.

        `half_precision` runs a U-Net of float32 weights in bfloat16; the images stay in float32.

        Raises:
            ConfigError: the network was not trained for a prompt.
        """
        # halves what is moved until the first convolution, which would round to it anyway
        precision = torch.bfloat16 if half_precision else self.stem.weight.dtype
        features, lidar_filled = painting_features(
            conditions, self.config.inputs, precision, composite=self.config.composite
        )
        candidates = build_candidates(conditions, self.config.inputs, lidar_filled)
        rows = torch.tensor([self.prompt_index(prompt) for prompt in prompts]).to(features.device)
        embedding, style = self.prompt(rows), self._style(rows)
        if style is not None:
            candidates = with_flat_colour(candidates, TINT, style.colour.sigmoid(), rows > 0)
        with torch.autocast(features.device.type, torch.bfloat16, enabled=half_precision):
            head = self._head(features, embedding, style)
        rgb, weights = self._image(head, candidates, style)
        return NanoOutput(
            rgb=rgb, base=candidates.base_image, log_error=head[:, -1].clamp(-8, 1), weights=weights
        )

    def _image(
        self,
        head: Float[Tensor, "batch outputs height width"],
        candidates: Candidates,
        style: Style | None,
    ) -> tuple[
        Float[Tensor, "batch 3 height width"], Float[Tensor, "batch candidates height width"]
    ]:
        """Colours, and the shares of the candidates in them: of none without a mix."""
        logits, residual = head[:, :-4], head[:, -4:-1]
        if not self.config.mix:
            return residual.sigmoid(), logits
        if style is not None:
            logits = logits + style.logits[..., None, None]
        weights = torch.softmax(candidates.allowed(logits), dim=1)
        change = self.config.residual_limit * torch.tanh(residual)
        return candidates.mixed(weights) + change, weights

    def _style(self, rows: Int[Tensor, " batch"]) -> Style | None:
        """What was learnt for each view's prompt; None where there are no styles."""
        if TINT not in self.config.candidates:
            return None
        learnt = STYLE_PACE * self.style(rows)
        fine = self.config.widths[0]
        return Style(*learnt.split([3, len(self.config.candidates), fine, fine], dim=1))

    def _head(
        self,
        features: Float[Tensor, "batch features height width"],
        embedding: Float[Tensor, "batch channels"],
        style: Style | None,
    ) -> Float[Tensor, "batch outputs height width"]:
        """Run the U-Net on an image of any size, padded to whole cells by repeating the edge."""
        height_px, width_px = features.shape[2:]
        step_px = CELL_PX * 4
        padding = (0, -width_px % step_px, 0, -height_px % step_px)
        padded = F.pad(features, padding, mode="replicate") if any(padding) else features
        fine = self.encode_fine(self._stemmed(padded))
        middle = self.encode_middle(self.down_middle(fine))
        coarse = self.down_coarse(middle) + embedding[..., None, None]
        coarse = self.encode_coarse(coarse)
        middle = self.decode_middle(self._joined(middle, self.up_middle(coarse)))
        fine = self.decode_fine(self._joined(fine, self.up_fine(middle)))
        last = self.last(fine)
        if style is not None:
            last = last * (1 + style.gain[..., None, None]) + style.shift[..., None, None]
        # a style is float32
        outputs = F.pixel_shuffle(self.head(F.silu(last).to(features.dtype)), CELL_PX)
        # planes that lie together: what follows works on one output at a time
        inside = outputs[..., :height_px, :width_px]
        return inside.to(torch.float32, memory_format=torch.contiguous_format)

    def _joined(
        self,
        skipped: Float[Tensor, "batch channels rows columns"],
        coarser: Float[Tensor, "batch finer_channels coarser_rows coarser_columns"],
    ) -> Float[Tensor, "batch channels rows columns"]:
        """What comes up from a coarser level, and the finer one it skipped."""
        raised = F.pixel_shuffle(coarser, 2)
        return skipped + raised if self.config.skips else raised

    def _stemmed(
        self, features: Float[Tensor, "batch features height width"]
    ) -> Float[Tensor, "batch channels rows columns"]:
        """The first convolution, over cells of pixels.

        It equals `stem(pixel_unshuffle(features))`, but with the channels of a pixel side by side
        on the way, so that whole rows of a cell are copied instead of single numbers.
        """
        size, channels, height_px, width_px = features.shape
        rows, columns = height_px // CELL_PX, width_px // CELL_PX
        places = features.view(size, channels, rows, CELL_PX, columns, CELL_PX)
        pixels = places.permute(0, 2, 4, 3, 5, 1)
        cells = pixels.reshape(size, rows, columns, -1).permute(0, 3, 1, 2)
        by_feature = self.stem.weight.unflatten(1, (channels, CELL_PX**2))
        weight = by_feature.transpose(1, 2).flatten(1, 2)
        return F.conv2d(cells, weight, self.stem.bias, padding=1)
