"""What a style needs of a fitted scene: an image of it, distance and sky in every pixel."""

from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.styles import StyleView


def style_view(
    builder: ConditionBuilder,
    camera: Camera,
    timestamp_ns: int,
    image: Float[Tensor, "height width 3"],
    sky_mask: Bool[Tensor, "height width"] | None = None,
) -> tuple[StyleView, Float[Tensor, "height width"]]:
    """An image of the scene with what styles it, and the LiDAR depth that supports it.

    `sky_mask` is that of a recorded image; by default what the Gaussians leave open is sky.

    Returns:
        The view, its depth that of the render corrected by LiDAR; and camera z in metres where the
        LiDAR hit, 0 elsewhere. All on the CPU, where styles are made.
    """
    render = builder.scene.render(camera, timestamp_ns)
    lidar = builder.lidar_image(camera, camera.taken_ns(timestamp_ns))
    sky = 1 - render.alpha.clamp(0, 1).cpu() if sky_mask is None else sky_mask.float()
    view = StyleView(
        rgb=image.cpu(),
        depth_m=builder.surface_m(render, lidar, camera).detach().cpu(),
        sky=sky.detach(),
        camera=camera,
    )
    return view, lidar.depth_m.cpu()
