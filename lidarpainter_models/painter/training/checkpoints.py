"""The state of a training and its checkpoint on disk.

A checkpoint is written aside and renamed whole. It carries the digest of the settings and of the
pairs, so that it is never continued with others.
"""

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.storage.whole_files import write_whole

CHECKPOINT_NAME = "training.pt"
UNSHAPING = ("checkpoint_every_s",)
"""Settings that do not change the weights."""


@dataclass(kw_only=True, eq=False)
class TrainingState:
    """Everything that changes from step to step."""

    trained: dict[str, nn.Parameter]
    averaged: dict[str, Tensor]
    optimisers: dict[str, torch.optim.AdamW]
    """Of the trained weights, and of the opponent if there is one, as a checkpoint calls them."""
    opponent: nn.Module | None = None
    step: int = 0
    cpu_s: float = 0.0
    running: dict[str, float] = field(default_factory=dict)
    """Sums of the losses since the last entry of the history."""
    history: list[dict[str, float]] = field(default_factory=list)

    @classmethod
    def start(
        cls, trained: Mapping[str, nn.Parameter], opponent: nn.Module | None
    ) -> "TrainingState":
        """The state before the first step."""
        averaged = {name: parameter.detach().clone() for name, parameter in trained.items()}
        optimisers = {"optimiser": _optimiser(list(trained.values()))}
        if opponent is not None:
            optimisers["opponent_optimiser"] = _optimiser(list(opponent.parameters()))
        return cls(
            trained=dict(trained), averaged=averaged, optimisers=optimisers, opponent=opponent
        )

    @property
    def device(self) -> torch.device:
        """Where the trained weights lie."""
        return next(iter(self.trained.values())).device

    @torch.no_grad()
    def take_averages(self) -> None:
        """Put the averaged weights into the network; the training is over then."""
        for name, parameter in self.trained.items():
            parameter.copy_(self.averaged[name])


def _optimiser(parameters: list[nn.Parameter]) -> torch.optim.AdamW:
    """Learning rate and weight decay are set at every step."""
    return torch.optim.AdamW(parameters, lr=0.0, betas=(0.9, 0.99))


def training_digest(
    config: Mapping[str, Any], pair_digests: Sequence[str], start: Mapping[str, Tensor] | None
) -> str:
    """SHA-256 of what shapes the weights.

    The weights of the `start` come in a fixed order.
    """
    shaping = {key: value for key, value in config.items() if key not in UNSHAPING}
    text = json.dumps([shaping, list(pair_digests)], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    for tensor in (start or {}).values():
        digest.update(tensor.detach().float().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: TrainingState, digest: str) -> None:
    """Write the state of a training.

    Raises:
        WriteError: the disk refuses; the previous checkpoint is kept.
    """
    saved: dict[str, Any] = {
        "digest": digest,
        "trained": {name: parameter.detach() for name, parameter in state.trained.items()},
        "averaged": state.averaged,
        "step": state.step,
        "cpu_s": state.cpu_s,
        "running": state.running,
        "history": state.history,
        **{name: optimiser.state_dict() for name, optimiser in state.optimisers.items()},
    }
    if state.opponent is not None:
        saved["opponent"] = state.opponent.state_dict()
    content = io.BytesIO()
    torch.save(saved, content)
    write_whole(path, content.getvalue())


def read_checkpoint(path: Path, state: TrainingState, digest: str) -> None:
    """Bring a fresh state to where a training stood.

    Raises:
        DataError: the file is damaged, or its weights are not those of this network.
        ConfigError: it belongs to a training with other settings or pairs.
    """
    try:
        saved = torch.load(path, weights_only=True, map_location=state.device)
        found = saved["digest"]
    except (OSError, RuntimeError, UnpicklingError, EOFError, KeyError, TypeError) as error:
        raise _unreadable(path, error) from None
    if found != digest:
        raise ConfigError(
            f"checkpoint {path} belongs to a training with other settings or pairs: "
            "remove it or use another checkpoint folder"
        )
    try:
        _restore(state, saved)
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise _unreadable(path, error) from None


@torch.no_grad()
def _restore(state: TrainingState, saved: Mapping[str, Any]) -> None:
    for kind, kept in (("trained", state.trained), ("averaged", state.averaged)):
        shapes = {name: tuple(tensor.shape) for name, tensor in kept.items()}
        found = {name: tuple(tensor.shape) for name, tensor in saved[kind].items()}
        for name in sorted(shapes.keys() | found.keys()):
            if shapes.get(name) != found.get(name):
                raise ValueError(
                    f"{name!r} has shape {found.get(name)}, expected {shapes.get(name)}"
                )
        for name, tensor in kept.items():
            tensor.copy_(saved[kind][name])
    for name, optimiser in state.optimisers.items():
        optimiser.load_state_dict(saved[name])
    if state.opponent is not None:
        state.opponent.load_state_dict(saved["opponent"])
    state.step, state.cpu_s = int(saved["step"]), float(saved["cpu_s"])
    state.running, state.history = dict(saved["running"]), list(saved["history"])


def _unreadable(path: Path, error: Exception) -> DataError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return DataError(f"{path} is not a readable training checkpoint: {reason}")
