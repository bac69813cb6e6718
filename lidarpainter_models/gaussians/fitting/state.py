"""All that a running fit is made of, and how it is kept and taken up again bit for bit.

Gaussians out of view lag behind (`gaussian_adam`). They are kept as they lag, together with their
blocks: catching up for a checkpoint would split their way differently from an undisturbed run's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.checkpoint import group_tensors
from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.densification import GradientTally, SetChange
from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.fitting.loss import Perceptual
from lidarpainter_models.gaussians.fitting.occlusion_culling import HiddenGaussians
from lidarpainter_models.gaussians.fitting.refinement import Refinement
from lidarpainter_models.gaussians.model.bending import REACH_M
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS, SH_CONSTANT, GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import SeenGaussians
from lidarpainter_models.gaussians.model.spatial_blocks import SpatialBlocks, View
from lidarpainter_models.gaussians.model.stored_scene import (
    copy_scene,
    scene_from_arrays,
    scene_to_arrays,
)
from lidarpainter_models.kernels.frustum_culling import MOST_SIGMAS
from lidarpainter_models.kernels.sparse_adam import (
    MOST_UNITS,
    AdamState,
    Parameters,
    catch_up,
    present_rows,
    step_rows,
)
from lidarpainter_models.storage.tensor_files import grouped

COLOUR_PIXELS = 0.5
"""A colour takes about half a step where its Gaussian fills this much of a pixel of a view. Adam's
normalisation would drive one that the recorded views barely show as fast as all others, by noise,
and from the next lane it is in full view. Shapes do not need it; there it costs sharpness.
"""
LEAST_SHAPE_GRADIENT = 1e-15
COLOURS = ("sh_dc", "sh_rest")


def most_sigmas(rates: LearningRates) -> float:
    """How far a Gaussian that is not stepped reaches at most, in its deviations when it was."""
    growth = math.exp(MOST_UNITS * max(rates.log_scale))
    return 1.001 * growth * (MOST_SIGMAS + MOST_UNITS * max(rates.means))


class GaussianAdam:
    """Adam (Kingma and Ba, 2015) over the parameters of a Gaussian set."""

    def __init__(
        self, gaussians: GaussianSet, rates: LearningRates, pixels_per_view: float
    ) -> None:
        """Start with empty moments; views have so many pixels on average."""
        least_colour_gradient = COLOUR_PIXELS * SH_CONSTANT / (3 * pixels_per_view)
        self.rates = rates
        self.state = AdamState.empty(
            len(gaussians),
            [value.shape[1:].numel() for value in gaussians.parameters().values()],
            [
                least_colour_gradient if name in COLOURS else LEAST_SHAPE_GRADIENT
                for name in PARAMETERS
            ],
            gaussians.means.device,
        )

    def seen(self, gaussians: GaussianSet, rows: Int[Tensor, " seen"]) -> SeenGaussians:
        """The given rows as they are now, ready to collect gradients."""
        seen = SeenGaussians.room(gaussians, rows)
        present_rows(self.state, _kept(gaussians), rows, _of_seen(seen.values()))
        return seen

    def step(self, gaussians: GaussianSet, seen: SeenGaussians, fraction: float) -> None:
        """Move every row that collected a gradient, in place, after a fraction of the fit."""
        step_rows(
            self.state,
            _kept(gaussians),
            seen.rows,
            _of_seen(seen.values()),
            _of_seen(seen.gradients()),
            [self.rates.at(name, fraction) for name in PARAMETERS],
        )

    def catch_up(self, gaussians: GaussianSet) -> None:
        """Bring the whole set up to date, in place."""
        catch_up(self.state, _kept(gaussians))

    def rebuild(self, kept: Int[Tensor, " kept"], num_added: int) -> None:
        """Follow a change of a set that was caught up: rows kept, then rows with empty moments."""
        state = self.state
        fresh = state.first.new_zeros((num_added, state.first.shape[1]))
        state.first = torch.cat([state.first[kept], fresh])
        state.second = torch.cat([state.second[kept], fresh])
        state.last = state.last.new_full((len(kept) + num_added,), state.count)

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint, beside the parameters as they stand in the set.

        Rows are not caught up for it: the fit that goes on must not differ from one that was
        never interrupted.
        """
        return {
            "first": self.state.first,
            "second": self.state.second,
            "last": self.state.last,
            "count": torch.tensor(self.state.count),
            "missed": torch.tensor(self.state.missed, dtype=torch.float64),
        }

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        state, device = self.state, self.state.first.device
        state.first, state.second, state.last = (
            tensors[name].to(device, copy=True) for name in ("first", "second", "last")
        )
        state.count = int(tensors["count"])
        state.missed = tensors["missed"].tolist()


def _of_seen(columns: dict[str, Tensor]) -> Parameters:
    """Leaves, or their gradients, as the optimiser sees them."""
    rest = {name: value for name, value in columns.items() if name != "sh"}
    return Parameters(**rest, harmonics=columns["sh"], more_harmonics=columns["sh"][:, :0])


def _kept(gaussians: GaussianSet) -> Parameters:
    """A whole set as the optimiser sees it; it writes into the set's memory."""
    columns = {name: value.detach() for name, value in gaussians.parameters().items()}
    harmonics, more_harmonics = columns.pop("sh_dc"), columns.pop("sh_rest")
    return Parameters(**columns, harmonics=harmonics, more_harmonics=more_harmonics)


@dataclass(eq=False, kw_only=True)
class FitState:
    """The scene with its optimisers, tallies, random state and history."""

    scene: GaussianScene
    """Its Gaussians out of view lag behind until `caught_up`."""
    gaussian_adam: GaussianAdam
    blocks: SpatialBlocks
    hidden: HiddenGaussians
    refinement: Refinement
    tally: GradientTally
    generator: torch.Generator
    config: FitConfig
    steps: int
    """Steps of the fit in all, as planned; a limit of time lowers them."""
    perceptual: Perceptual | None = None
    """Distance of images, where one has a weight."""
    waiting: list[int] = field(default_factory=list)
    """Groups of views still to be drawn from in this pass."""
    step: int = 0
    sought_lamps: bool = False
    """Whether lamps were looked for already."""
    cpu_s: float = 0.0
    """Process CPU seconds spent so far, earlier runs included."""
    history: list[dict[str, float]] = field(default_factory=list)
    recent: list[Float[Tensor, "2"]] = field(default_factory=list)
    """Loss and squared error of the steps since the last entry of the history; read together, for
    the host waits for the device whenever it reads."""

    @classmethod
    def begin(
        cls,
        scene: GaussianScene,
        config: FitConfig,
        pixels_per_view: float,
        perceptual: Perceptual | None = None,
    ) -> "FitState":
        """A fit before its first step; takes its own copy of the scene."""
        scene = copy_scene(scene)
        scene = scene.with_gaussians(scene.gaussians.as_leaves())
        generator = torch.Generator()
        generator.manual_seed(config.seed)
        return cls(
            scene=scene,
            gaussian_adam=GaussianAdam(scene.gaussians, config.learning_rates, pixels_per_view),
            blocks=SpatialBlocks.of(scene.gaussians, most_sigmas(config.learning_rates)),
            hidden=HiddenGaussians.none_yet(scene.num_gaussians, scene.device),
            refinement=Refinement.begin(scene, config),
            tally=GradientTally.zeros(scene.num_gaussians, scene.device),
            generator=generator,
            config=config,
            steps=config.steps,
            perceptual=perceptual,
        )

    @property
    def fraction(self) -> float:
        """Part of the fit that is done, 0 to 1."""
        return self.step / self.steps

    def next_view(self, groups: Sequence[Sequence[int]]) -> int:
        """Any view of the next group, of a random order that has each group once before any twice.

        Views that show the same count as one (see `seen_surface`).
        """
        if not self.waiting:
            self.waiting = torch.randperm(len(groups), generator=self.generator).tolist()
        group = groups[self.waiting.pop()]
        if len(group) == 1:
            return group[0]
        return group[int(torch.randint(len(group), (), generator=self.generator))]

    def random(self) -> float:
        """A uniform number in [0, 1)."""
        return float(torch.rand((), generator=self.generator))

    def seen(self, looks: Mapping[int, Sequence[View]]) -> SeenGaussians:
        """All Gaussians that any of these can show, as leaves for one step.

        By view, as `occlusion_culling` calls them, where it and its bodies stand, in one or more
        moments.
        """
        bent_m = REACH_M if len(self.scene.actors.bending.bodies) else 0.0
        seen = [
            self.hidden.without(self.blocks.in_view(views, actor_slack_m=bent_m), name)
            for name, views in looks.items()
        ]
        rows = torch.stack(seen).any(dim=0).nonzero()[:, 0]
        return self.gaussian_adam.seen(self.scene.gaussians, rows)

    def step_gaussians(self, seen: SeenGaussians) -> None:
        """Move the Gaussians that collected gradients."""
        self.gaussian_adam.step(self.scene.gaussians, seen, self.fraction)
        self.blocks.refresh(self.scene.gaussians, seen.rows)

    def caught_up(self) -> GaussianScene:
        """The scene with every Gaussian where the steps so far put it."""
        self.gaussian_adam.catch_up(self.scene.gaussians)
        return self.scene

    def apply(self, change: SetChange) -> None:
        """Take over a changed set of Gaussians, made from `caught_up`; tallies start again."""
        self.scene = self.scene.with_gaussians(change.gaussians.as_leaves())
        self.gaussian_adam.rebuild(change.kept, change.num_added)
        self.blocks = SpatialBlocks.of(self.scene.gaussians, self.blocks.reach_sigmas)
        self.hidden.follow(change.kept, change.num_added)
        self.tally = GradientTally.zeros(len(change.gaussians), self.scene.device)

    def take_lamps(self, scene: GaussianScene) -> None:
        """Take over lamps that were found in `caught_up`, and the Gaussians as dark as off."""
        with torch.no_grad():
            self.scene.gaussians.sh_dc.copy_(scene.gaussians.sh_dc)
        self.scene = replace(self.scene, blinking=scene.blinking)
        self.sought_lamps = True

    def log(self) -> None:
        """Add an entry to the history: means since the one before."""
        losses, errors = zip(*(self.recent_numbers() or [[0.0, 1.0]]), strict=True)
        self.history.append(
            {
                "step": float(self.step),
                "loss": sum(losses) / len(losses),
                "psnr": sum(-10 * math.log10(max(error, 1e-10)) for error in errors) / len(errors),
                "num_gaussians": float(self.scene.num_gaussians),
                "cpu_s": self.cpu_s,
            }
        )
        self.recent = []

    def keep(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and JSON-able numbers of the whole state."""
        scene_arrays, scene_metadata = scene_to_arrays(self.scene)
        tensors = group_tensors(
            {
                "scene": scene_arrays,
                "gaussian_adam": self.gaussian_adam.tensors(),
                "blocks": {"block_of_row": self.blocks.block_of_row},
                "hidden": self.hidden.tensors(),
                **{name: adam.tensors() for name, adam in self.refinement.adams.items()},
                "tally": vars(self.tally),
                "random": {"state": self.generator.get_state()},
            }
        )
        numbers = {
            "scene": scene_metadata,
            "waiting": self.waiting,
            "step": self.step,
            "sought_lamps": self.sought_lamps,
            "cpu_s": self.cpu_s,
            "history": self.history,
            "recent": self.recent_numbers(),
        }
        return tensors, numbers

    def recent_numbers(self) -> list[list[float]]:
        """Loss and squared error of the steps since the last entry of the history."""
        return torch.stack(self.recent).tolist() if self.recent else []

    @classmethod
    def resume(
        cls,
        tensors: dict[str, Tensor],
        numbers: dict[str, Any],
        config: FitConfig,
        pixels_per_view: float,
        device: torch.device | None = None,
        perceptual: Perceptual | None = None,
    ) -> "FitState":
        """The state that `keep` described; where it was kept from does not matter."""
        groups = grouped(tensors, "/")
        scene = scene_from_arrays(groups["scene"], numbers["scene"])
        scene = scene if device is None else scene.to(device)
        state = cls.begin(scene, config, pixels_per_view, perceptual)
        state.gaussian_adam.load(groups["gaussian_adam"])
        for name, adam in state.refinement.adams.items():
            adam.load(groups[name])
        state.blocks = SpatialBlocks.with_rows_in(
            groups["blocks"]["block_of_row"].to(device),
            state.scene.gaussians,
            state.blocks.reach_sigmas,
        )
        state.hidden = HiddenGaussians.from_tensors(groups["hidden"], state.scene.device)
        tally = {name: value.to(device) for name, value in groups["tally"].items()}
        state.tally = GradientTally(**tally)
        state.generator.set_state(groups["random"]["state"])
        state.waiting = list(numbers["waiting"])
        state.step, state.cpu_s = numbers["step"], numbers["cpu_s"]
        state.sought_lamps = numbers.get("sought_lamps", False)
        state.history = list(numbers["history"])
        state.recent = [
            torch.tensor(pair, dtype=torch.float64, device=device) for pair in numbers["recent"]
        ]
        return state
