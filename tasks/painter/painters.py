"""Painters by name, and the digest by which a stage knows which one it used."""

from functools import lru_cache
from pathlib import Path

from catalog.digests import DIGEST_LENGTH, digest_file, digest_text
from lidarpainter_models.errors import WeightsError
from lidarpainter_models.painter import BUNDLED_NANO, PAINTER_NAMES, is_one_step
from lidarpainter_models.painter.baselines import UnpaintedPainter
from lidarpainter_models.painter.one_step.loading import painter_files, split_preset

NO_PAINTER = UnpaintedPainter.name


def painter_digest(name_or_path: str) -> str:
    """What a painting depends on besides the source: the weights, or the name of a rule.

    Raises:
        WeightsError: no such painter, or its weights are missing.
    """
    if is_one_step(name_or_path):
        _, preset = split_preset(name_or_path)
        parts = [_large_digest(path) for path in files_of_painter(name_or_path)]
        return digest_text("\n".join([preset, *parts]))
    files = files_of_painter(name_or_path)
    return _weights_digest(files[0]) if files else name_or_path


def files_of_painter(name_or_path: str) -> list[Path]:
    """The files that a painter is made of; none for one that learns nothing.

    Raises:
        WeightsError: a model is not there.
    """
    if name_or_path == "nano":
        return [BUNDLED_NANO]
    if is_one_step(name_or_path):
        return painter_files(name_or_path)
    return [] if name_or_path in PAINTER_NAMES else [Path(name_or_path)]


def _large_digest(path: Path) -> str:
    """SHA-256 of a file of gigabytes, read again only once it has changed."""
    found = path.stat()
    return _remembered_digest(path, found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=64)
def _remembered_digest(path: Path, size: int, changed_ns: int) -> str:  # noqa: ARG001 - the key
    return digest_file(path)


def _weights_digest(path: Path) -> str:
    if path.suffix != ".safetensors":
        raise WeightsError(
            f"no painter {str(path)!r}: expected {', '.join(PAINTER_NAMES)}, a .safetensors file "
            "or a folder in diffusers' layout"
        )
    try:
        return digest_file(path)[:DIGEST_LENGTH]
    except OSError as error:
        raise WeightsError(f"no painter weights at {path}: {error.strerror}") from None
