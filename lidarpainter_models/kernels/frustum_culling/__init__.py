"""Which Gaussians a view can show, by blocks of them with bounds: frustum culling.

What is left out here is left out by the rasteriser too.
"""

from collections.abc import Sequence

from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.frustum_culling.blocks import MOST_SIGMAS, Blocks, Look, frustum_of

__all__ = ["MOST_SIGMAS", "Blocks", "mark_seen", "refresh_bounds"]


def refresh_bounds(
    blocks: Blocks,
    means: Float[Tensor, "gaussians 3"],
    log_scale: Float[Tensor, "gaussians 3"],
    is_stale: Bool[Tensor, " blocks"],
    *,
    reach_sigmas: float,
    backend: Backend = "auto",
) -> None:
    """Bound the stale blocks, in place: a Gaussian reaches so many of its longest deviation.

    A Gaussian that is not finite is never drawn and has no part in it.

    Raises:
        ShapeError: the blocks are of another number of Gaussians, or the flags of blocks.
    """
    if means.shape != (len(blocks.order), 3) or log_scale.shape != means.shape:
        raise ShapeError(
            f"blocks of {len(blocks.order)} Gaussians need as many centres and scales, got "
            f"{tuple(means.shape)} and {tuple(log_scale.shape)}"
        )
    if is_stale.shape != blocks.body.shape:
        raise ShapeError(f"{len(blocks.body)} blocks need as many flags, got {len(is_stale)}")
    refresh = implementation("frustum_culling", "refresh_bounds", backend, means.device)
    refresh(blocks, means.detach(), log_scale.detach(), is_stale, reach_sigmas)


def mark_seen(
    blocks: Blocks,
    views: Sequence[tuple[Camera, Float[Tensor, "bodies 4 4"]]],
    is_seen: Bool[Tensor, " gaussians"],
    *,
    actor_slack_m: float = 0.0,
    backend: Backend = "auto",
) -> None:
    """Mark, in place, all Gaussians of blocks that may reach into any of the views.

    A view is a camera and where it has the bodies. `actor_slack_m` is how far actors may still
    move before they are drawn.

    Raises:
        ShapeError: there is not one flag for each Gaussian, or views differ in bodies.
    """
    if is_seen.shape != blocks.order.shape:
        raise ShapeError(f"{len(blocks.order)} Gaussians need as many flags, got {len(is_seen)}")
    counts = sorted({len(camera_from_body) for _, camera_from_body in views})
    if len(counts) > 1:
        raise ShapeError(f"views of one scene have the same bodies, got {counts} of them")
    mark = implementation("frustum_culling", "mark_seen", backend, is_seen.device)
    looks = [
        Look(camera_from_body.detach().double(), frustum_of(camera, actor_slack_m))
        for camera, camera_from_body in views
    ]
    mark(blocks, looks, is_seen)
