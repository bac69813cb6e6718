"""The packages of the extra `diffusion`: imported when needed, and named where they are missing.

Together they take 10 to 20 seconds to import, so no module imports them at its top.
"""

import warnings
from importlib import import_module
from typing import Any

from lidarpainter_models.errors import MissingPackageError


def diffusion_package(name: str) -> Any:  # noqa: ANN401 - a module without type stubs
    """Import `diffusers`, `transformers`, `peft` or `huggingface_hub`.

    Raises:
        MissingPackageError: the package is not installed or cannot be imported.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # advice to their authors, not to our users
            return import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"the one-step painter needs the package {name} ({error}): "
            "pip install 'lidarpainter[diffusion]'"
        ) from None
