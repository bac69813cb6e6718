"""LidarPainter's library: scenes, kernels, Gaussians and painters; tensors in, tensors out.

`import lidarpainter_models as lp` gives the names of `lidarpainter_models.api`, which is imported
when the first of them is used.
"""

from typing import Any

__version__ = "0.3.0"
__all__ = [
    "ConditionBuilder",
    "FitConfig",
    "ObservationConfig",
    "Shift",
    "SyntheticStreetConfig",
    "camera_beside",
    "evaluate",
    "fit_gaussians",
    "load_painter",
    "open_scene",
    "prepare_observations",
    "split_views",
    "write_png",
    "write_street",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - `__init__.pyi` has the types
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # in here: importing a room neither imports all the others nor counts them in a stage's key
    from lidarpainter_models import api

    return getattr(api, name)
