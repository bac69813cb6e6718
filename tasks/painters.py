"""Painters by name, and the digest by which a stage knows which one it used."""

from pathlib import Path

from catalog.digests import DIGEST_LENGTH, digest_file
from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter import BUNDLED_NANO, PAINTER_NAMES
from lidarpainter_models.painter.baselines import UnpaintedPainter

NO_PAINTER = UnpaintedPainter.name


def painter_digest(name_or_path: str) -> str:
    """What a painting depends on besides the source: the weights, or the name of a rule.

    Raises:
        WeightsError: no such painter, or its weights are missing.
    """
    if name_or_path == "nano":
        return _weights_digest(BUNDLED_NANO)
    if name_or_path in PAINTER_NAMES:
        return name_or_path
    return _weights_digest(Path(name_or_path))


def _weights_digest(path: Path) -> str:
    if path.suffix != ".safetensors":
        raise WeightsError(
            f"no painter {str(path)!r}: expected {', '.join(PAINTER_NAMES)} or a .safetensors file"
        )
    try:
        return digest_file(path)[:DIGEST_LENGTH]
    except OSError as error:
        raise WeightsError(f"no painter weights at {path}: {error.strerror}") from None
