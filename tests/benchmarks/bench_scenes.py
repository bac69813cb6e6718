"""Seeded scenes whose work is like a street's, at any size."""

import torch

from lidarpainter_models.geometry.cameras import Camera

LEARNED = ("means", "rotation_wxyz", "scale_m", "opacity", "sh", "camera_from_body")


def street_like_splats(count, width_px, height_px):
    """Gaussians of degree 3 that fill the image, near ones rarer, each about as wide on it."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    focal_px = 0.6 * width_px
    z = 3.0 + 57.0 * uniform(count) ** 1.5
    x = (uniform(count) - 0.5) * width_px / focal_px * z
    y = (uniform(count) - 0.5) * height_px / focal_px * z
    size_px = 0.75 * (width_px * height_px / count) ** 0.5
    splats = {
        "means": torch.stack([x, y, z], dim=1),
        "rotation_wxyz": normal(count, 4),
        "scale_m": torch.exp(0.5 * normal(count, 3)) * (size_px * z / focal_px)[:, None],
        "opacity": torch.sigmoid(1.5 * normal(count)),
        "sh": 0.3 * normal(count, 16, 3),
        "body_index": torch.zeros(count, dtype=torch.int32),
        "camera_from_body": torch.eye(4)[None],
    }
    for name in LEARNED:
        splats[name].requires_grad_()
    pose, size = torch.eye(4, dtype=torch.float64), {"width_px": width_px, "height_px": height_px}
    return splats | {"camera": Camera.centred(pose, focal_px, **size)}


def street_like_points(count, width_px, height_px):
    """LiDAR-like points: most of them far and small, a few near and wide."""
    generator = torch.Generator().manual_seed(0)
    depth_m = 3.0 + 77.0 * torch.rand(count, generator=generator)
    u = torch.randint(0, width_px, (count,), generator=generator)
    v = torch.randint(0, height_px, (count,), generator=generator)
    return {
        "pixels_uv": torch.stack([u, v], dim=1),
        "depth_m": depth_m,
        "radius_px": (8.0 / depth_m).to(torch.int64),
        "height_px": height_px,
        "width_px": width_px,
    }
