"""FID and KID of what a scene shows beside the path, against recorded images of the same drive."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.metrics.fid import LEAST_IMAGES, TOO_FEW, frechet_distance, kernel_distance
from lidarpainter_models.metrics.inception import NO_WEIGHTS, Inception
from lidarpainter_models.scenes.records import RecordedView

Images = Iterable[Float[Tensor, "_height _width 3"]]
PlacedView = tuple[RecordedView, Camera]
"""A recorded view and the camera, at fit size, that looks in its place."""


def fid_scores(
    network: Inception | None, real: Images, shown: Mapping[str, Images]
) -> dict[str, dict[str, Any]]:
    """`fid` and `kid` of each set of shown images, or None with the reason.

    Args:
        network: Inception; without it nothing is looked at.
        real: recorded images, rgb 0..1.
        shown: images of each trajectory, rgb 0..1.

    Returns:
        By trajectory: `fid`, `kid`, `num_real` and `num_shown` images, or `fid_reason` and
        `kid_reason`.
    """
    if network is None:
        return {name: _absent(NO_WEIGHTS) for name in shown}
    truth = network.features_of(real)
    found = {}
    for name, images in shown.items():
        features = network.features_of(images)
        if min(len(truth), len(features)) < LEAST_IMAGES:
            found[name] = _absent(TOO_FEW)
            continue
        found[name] = {
            "fid": frechet_distance(truth, features),
            "kid": kernel_distance(truth, features),
            "num_real": len(truth),
            "num_shown": len(features),
        }
    return found


def _absent(reason: str) -> dict[str, Any]:
    return {"fid": None, "fid_reason": reason, "kid": None, "kid_reason": reason}


def shown_images(
    shown: ShownScene, views: Sequence[PlacedView], told: Callable[[], None]
) -> Iterator[Float[Tensor, "_height _width 3"]]:
    """What a scene shows in the place of each view; `told` is called after each."""
    renderer = cache(shown.renderer)

    def drawn(placed: PlacedView) -> Float[Tensor, "height width 3"]:
        view, camera = placed
        return renderer(view.camera_name)(camera, view.timestamp_ns)

    for image in side_by_side(drawn, views, shown.scene.device):
        told()
        yield image
