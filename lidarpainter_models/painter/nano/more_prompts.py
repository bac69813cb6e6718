"""Teach a trained network more prompts without changing what it does for those it knows."""

from dataclasses import replace

import torch

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.nano.network import CELL_PX, NanoConfig, NanoNetwork


def is_extension(config: NanoConfig, known: NanoConfig) -> bool:
    """Whether a shape differs from a known one by further prompts alone."""
    first = config.prompts[: len(known.prompts)]
    return first == known.prompts and replace(known, prompts=config.prompts) == config


@torch.no_grad()
def with_more_prompts(network: NanoNetwork, config: NanoConfig) -> NanoNetwork:
    """A network of the given shape that paints every known prompt as before, bit for bit.

    New prompts start as the first; where the network had no tint, its head starts without a
    preference for it.

    Raises:
        ConfigError: the shapes differ by more than prompts.
    """
    if not is_extension(config, network.config):
        raise ConfigError(
            f"cannot start a network {config.to_dict()} from the weights of "
            f"{network.config.to_dict()}"
        )
    extended = NanoNetwork(config)
    state = extended.state_dict()
    num_known = len(network.config.prompts)
    num_old, num_new = len(network.config.candidates), len(config.candidates)
    for name, tensor in network.state_dict().items():
        if name in ("prompt.weight", "style.weight"):
            state[name][:num_known] = tensor
            state[name][num_known:] = tensor[0]
        elif name.startswith("head.") and num_new > num_old:
            cells = CELL_PX**2
            state[name][: num_old * cells] = tensor[: num_old * cells]
            state[name][num_old * cells : num_new * cells] = 0
            state[name][num_new * cells :] = tensor[num_old * cells :]
        else:
            state[name] = tensor
    extended.load_state_dict(state)
    return extended
