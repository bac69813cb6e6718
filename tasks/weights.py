"""Digests of the weights that users supply for perceptual distances."""

from pathlib import Path

from catalog.digests import DIGEST_LENGTH, digest_file
from lidarpainter_models.errors import WeightsError
from lidarpainter_models.evaluation.judging import JudgeConfig


def weights_digests(config: JudgeConfig) -> dict[str, str]:
    """What the perceptual distances depend on, by the part each file plays.

    Raises:
        WeightsError: a file is not there.
    """
    return {name: _digest_of(path) for name, path in config.weight_files.items()}


def _digest_of(path: Path) -> str:
    try:
        return digest_file(path)[:DIGEST_LENGTH]
    except OSError as error:
        raise WeightsError(f"no weights at {path}: {error.strerror}") from None
