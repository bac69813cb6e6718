"""The state of a training and its checkpoint on disk.

A checkpoint is written aside and renamed whole. It carries the digest of the settings and of the
pairs, so that it is never continued with others.
"""

import hashlib
import io
import json
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.painter.nano.more_prompts import with_more_prompts
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.whole_files import write_whole


@dataclass(kw_only=True, eq=False)
class TrainingState:
    """Everything that changes from step to step."""

    network: NanoNetwork
    averaged: NanoNetwork
    optimiser: torch.optim.AdamW
    step: int = 0
    cpu_s: float = 0.0
    running: dict[str, float] = field(default_factory=dict)
    """Sums of the losses since the last entry of the history."""
    history: list[dict[str, float]] = field(default_factory=list)

    @classmethod
    def start(
        cls, config: NanoConfig, seed: int, device: torch.device, weights: NanoNetwork | None = None
    ) -> "TrainingState":
        """First weights: those given, or such as follow from the seed alone.

        Raises:
            ConfigError: the weights given belong to a network that differs by more than prompts.
        """
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = NanoNetwork(config) if weights is None else with_more_prompts(weights, config)
        # torch's stub lacks memory_format
        network = network.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        averaged = deepcopy(network).requires_grad_(False)
        # the learning rate is set at every step
        optimiser = torch.optim.AdamW(network.parameters(), lr=0.0, betas=(0.9, 0.99))
        return cls(network=network, averaged=averaged, optimiser=optimiser)


def training_digest(
    config: dict[str, Any], pair_digests: Sequence[str], start: NanoNetwork | None = None
) -> str:
    """SHA-256 of the settings that shape the weights, of the pairs, and of the first weights."""
    shaping = {key: value for key, value in config.items() if key != "checkpoint_every_s"}
    text = json.dumps([shaping, list(pair_digests)], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    if start is not None:
        for tensor in start.state_dict().values():
            digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def write_checkpoint(path: Path, state: TrainingState, digest: str) -> None:
    """Write the state of a training.

    Raises:
        StorageError: the disk refuses; the previous checkpoint is kept.
    """
    content = io.BytesIO()
    torch.save(
        {
            "digest": digest,
            "network": state.network.state_dict(),
            "averaged": state.averaged.state_dict(),
            "optimiser": state.optimiser.state_dict(),
            "step": state.step,
            "cpu_s": state.cpu_s,
            "running": state.running,
            "history": state.history,
        },
        content,
    )
    write_whole(path, content.getvalue())


def read_checkpoint(path: Path, state: TrainingState, digest: str) -> None:
    """Bring a fresh state to where a training stood.

    Raises:
        DataError: the file is damaged.
        ConfigError: it belongs to a training with other settings or pairs.
    """
    device = state.network.head.weight.device
    try:
        saved = torch.load(path, weights_only=True, map_location=device)
        found = saved["digest"]
    except (OSError, RuntimeError, UnpicklingError, EOFError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"{path} is not a readable training checkpoint: {reason}") from None
    if found != digest:
        raise ConfigError(
            f"checkpoint {path} belongs to a training with other settings or pairs: "
            "remove it or use another checkpoint folder"
        )
    state.network.load_state_dict(saved["network"])
    state.averaged.load_state_dict(saved["averaged"])
    state.optimiser.load_state_dict(saved["optimiser"])
    state.step, state.cpu_s = saved["step"], saved["cpu_s"]
    state.running, state.history = dict(saved["running"]), list(saved["history"])
