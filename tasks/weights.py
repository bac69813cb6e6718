"""Digests of the weights that users supply for perceptual distances."""

from collections.abc import Mapping
from pathlib import Path

from catalog.digests import DIGEST_LENGTH, digest_file
from lidarpainter_models.errors import WeightsError


def file_digests(files: Mapping[str, Path]) -> dict[str, str]:
    """Digests of files, by the part each plays.

    Raises:
        WeightsError: a file is not there.
    """
    found = {}
    for name, path in files.items():
        try:
            found[name] = digest_file(path)[:DIGEST_LENGTH]
        except OSError as error:
            raise WeightsError(f"no weights at {path}: {error.strerror}") from None
    return found
