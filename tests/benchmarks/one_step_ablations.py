"""Ablations of the one-step painter: wirings that differ from one in a single choice.

A table per choice, each with the wiring itself in it, so that figures can be compared within a
table and all of them were trained alike.
"""

from dataclasses import replace
from typing import get_args

from lidarpainter_models.painter.one_step.config import (
    INPUTS,
    LidarInput,
    OneStepConfig,
    SkipSource,
)
from lidarpainter_models.painter.one_step.latent_fusion import FusionConfig
from lidarpainter_models.painter.one_step.schedule import Denoise
from lidarpainter_models.painter.one_step.training import OneStepTrainingConfig

TIMESTEPS = (999, 200, 199)
"""SD-Turbo's own, that of the authors' program, and DIFIX's."""
GUIDANCE = (
    ("render",),
    ("lidar",),
    ("render", "warp"),
    ("lidar", "warp"),
    ("render", "lidar"),
    INPUTS,
)
"""What the painter sees; the paper's rows, with the warped image for its reference."""

Wirings = dict[str, OneStepConfig]


def wirings_by_choice(config: OneStepConfig) -> dict[str, Wirings]:
    """Tables of wirings by the choice that is varied; each holds `config` under its own value.

    A choice that the wiring does not leave open (skips of the tiny autoencoder, the fusion of a
    single input) has no table.
    """
    guidance = dict.fromkeys((*GUIDANCE, config.inputs))
    times = dict.fromkeys((*TIMESTEPS, config.timestep))
    tables: dict[str, Wirings] = {
        "inputs": {"+".join(seen): _with_inputs(config, seen) for seen in guidance},
        "t": {str(time): replace(config, timestep=time) for time in times},
        "step": {kind: replace(config, denoise=kind) for kind in get_args(Denoise)},
        "skips": {kind: replace(config, skips=kind) for kind in _skip_sources(config)},
        "fusion": {"on": config, "off": _without_fusion(config)},
        "lidar": {kind: replace(config, lidar=kind) for kind in get_args(LidarInput)},
    }
    if config.fusion is None:
        del tables["fusion"]
    if "lidar" not in config.inputs:
        del tables["lidar"]
    return {choice: wirings for choice, wirings in tables.items() if len(wirings) > 1}


def ablation_tables(
    training: OneStepTrainingConfig,
) -> dict[str, dict[str, OneStepTrainingConfig]]:
    """The recipes of each table by row, as `flows.ablate_painter` takes them."""
    return {
        choice: {
            f"{choice}: {value}": replace(training, network=wiring)
            for value, wiring in wirings.items()
        }
        for choice, wirings in wirings_by_choice(training.network).items()
    }


def _with_inputs(config: OneStepConfig, inputs: tuple[str, ...]) -> OneStepConfig:
    """Other inputs; one of them alone has no fusion, and skips that a fusion mixed are its own."""
    if len(inputs) == 1:
        return replace(_without_fusion(config), inputs=inputs)
    fusion = config.fusion
    if fusion is not None and fusion.kind == "as-shipped" and len(inputs) != 2:
        fusion = FusionConfig(channels=fusion.channels)  # the authors' is for two inputs
    if fusion is None and len(config.inputs) == 1:
        fusion = FusionConfig()
    return replace(config, inputs=inputs, fusion=fusion)


def _skip_sources(config: OneStepConfig) -> list[SkipSource]:
    """Those that the autoencoder and the fusion allow."""
    if config.autoencoder == "taesd":
        return ["none"]
    return [kind for kind in get_args(SkipSource) if kind != "fused" or config.fusion is not None]


def _without_fusion(config: OneStepConfig) -> OneStepConfig:
    skips: SkipSource = "render" if config.skips == "fused" else config.skips
    return replace(config, fusion=None, skips=skips)
