"""What tasks are given: words that any process understands, never tensors."""

from dataclasses import dataclass
from pathlib import Path

from catalog.artefacts import ArtefactRef
from lidarpainter_models.devices import Device, KernelChoice


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitSpec:
    """Which views of a scene may be seen."""

    scene_id: str
    spec: str = "alternate"
    """`alternate`, `forward:17:8` or `all`; see `lidarpainter_models.scenes.splits`."""
    cameras: tuple[str, ...] | None = None
    """Cameras to train on and to judge; None takes all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSpec:
    """What a run works on, in words that any process understands."""

    store_path: Path
    split: SplitSpec
    painter: str
    """Name of a painter, or path of its weights or model."""
    device: Device = "auto"
    kernels: KernelChoice = "auto"


@dataclass(frozen=True, slots=True)
class FittedRef:
    """A fitted scene and what it was fitted to."""

    observations: ArtefactRef
    gaussians: ArtefactRef


def street_id(seed: int) -> str:
    """Scene id of the synthetic street of a seed."""
    return f"synthetic/street-{seed:04d}"
