"""The constants that decide which Gaussians a pixel sees, the same in every backend.

They are those of Kerbl et al. (2023), "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", except that a Gaussian ends where its alpha falls under `ALPHA_CUT` and not at three
standard deviations (Hanson et al. 2025, "Speedy-Splat").
"""

from lidarpainter_models.geometry.cameras import Camera

TILE_PX = 16
"""Side of a square screen tile."""

ALPHA_CUT = 1.0 / 255.0
"""A Gaussian is not blended where its alpha is under this."""

MAX_ALPHA = 0.99
"""Alpha is clamped here, so that something always passes and the gradient stays finite."""

MIN_TRANSMITTANCE = 1e-4
"""A pixel stops before the Gaussian that would bring its transmittance under this."""

TANGENT_MARGIN = 0.3
"""How far outside the image, in half field-of-view tangents, the projection stays linearised."""

COLOUR_OFFSET = 0.5
"""Grey that spherical harmonics of zero stand for."""

NEAR_M = 0.1
"""Gaussians with a smaller camera z are not drawn."""

BLUR_PX2 = 0.3
"""Added to the variance of every footprint, so that none is thinner than a pixel."""


def linear_tangents(camera: Camera) -> tuple[float, float, float, float]:
    """Tangents within which projection stays linear: lowest and highest x/z, then those of y/z."""
    margin_x = TANGENT_MARGIN * 0.5 * camera.width_px / camera.fx_px
    margin_y = TANGENT_MARGIN * 0.5 * camera.height_px / camera.fy_px
    return (
        -camera.cx_px / camera.fx_px - margin_x,
        (camera.width_px - camera.cx_px) / camera.fx_px + margin_x,
        -camera.cy_px / camera.fy_px - margin_y,
        (camera.height_px - camera.cy_px) / camera.fy_px + margin_y,
    )
