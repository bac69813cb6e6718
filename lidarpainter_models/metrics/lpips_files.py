"""Where the weights of LPIPS lie; read without tensors."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class LpipsFiles:
    """Where the two halves of the weights lie; either may be missing."""

    backbone: Path | None = None
    """torchvision's VGG-16, AlexNet or SqueezeNet 1.1."""
    heads: Path | None = None
    """The linear heads of the same network, version 0.1."""

    @property
    def named(self) -> dict[str, Path]:
        """The files that are named, by the part they play."""
        files = {"lpips backbone": self.backbone, "lpips heads": self.heads}
        return {name: path for name, path in files.items() if path is not None}

    @property
    def missing(self) -> str | None:
        """Why there can be no figure; None where both are named."""
        halves = {"a backbone": self.backbone, "linear heads": self.heads}
        lacking = [name for name, path in halves.items() if path is None]
        if not lacking:
            return None
        return f"LPIPS needs weights that the user supplies: {' and '.join(lacking)} not given"
