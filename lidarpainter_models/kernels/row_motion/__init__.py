"""By how much Gaussians move and stretch until a rolling shutter reads their pixels.

A centre moves by its velocity before the camera times how long after the middle of the image its
pixel is read (Seiskari et al., "Gaussian Splatting on the Move", 2024); each axis grows by as much
as its ends are moved apart, to first order. Body frame: of the street the world, of an actor its
box; camera frame: x right, y down, z forward; metres, seconds, pixels.
"""

from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation

ROUNDS = 2  # a second guess of where a centre is read moves it by less than 0.01 px
NEAR_M = 0.05
"""Points nearer to the camera's plane than this are projected as from there."""
MOST_GROWTH = 2.0
"""By which an axis is made longer at most, or shorter: what passes right before a camera."""


def motion_until_read(
    means: Float[Tensor, "gaussians 3"],
    rotation_wxyz: Float[Tensor, "gaussians 4"],
    body_index: Int[Tensor, " gaussians"],
    camera_from_body: Float[Tensor, "bodies 3 4"],
    metres_per_s: Float[Tensor, "bodies 3 4"],
    camera: Camera,
    *,
    backend: Backend = "auto",
) -> tuple[Float[Tensor, "gaussians 3"], Float[Tensor, "gaussians 3"]]:
    """Offsets of centres (metres) and logarithms of the axes' growth; without gradient.

    Args:
        means: centres in the frames of their bodies, metres.
        rotation_wxyz: axes in the frames of their bodies, not necessarily of unit length.
        body_index: which body each Gaussian belongs to.
        camera_from_body: where the bodies stand in the middle of the image.
        metres_per_s: a body's matrix times (point, 1) is the point's velocity before the camera,
            in the frame of the body.
        camera: with a rolling shutter.
        backend: which implementation runs.

    Raises:
        ShapeError: the bodies' two matrices differ in number.
    """
    if camera_from_body.shape != metres_per_s.shape:
        raise ShapeError(
            f"{len(camera_from_body)} bodies need a velocity each, got {len(metres_per_s)}"
        )
    move = implementation(
        "row_motion", "motion_until_read", backend, means.device, dtype=means.dtype
    )
    poses, rates = (matrices.detach().to(means) for matrices in (camera_from_body, metres_per_s))
    shapes = (each.detach() for each in (means, rotation_wxyz))
    return move(*shapes, body_index, poses, rates, camera)
