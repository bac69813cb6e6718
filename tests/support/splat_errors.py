"""Scenes of every kind for `random_splats`, and how far two backends are apart on one."""


def image_errors(actual, expected):
    scale = {"rgb": 1.0, "depth_m": 20.0, "alpha": 1.0, "features": 3.0}
    return {
        name: (getattr(actual, name) - getattr(expected, name)).detach().abs().mean().item() / size
        for name, size in scale.items()
        if getattr(expected, name).numel()
    }


def relative_errors(actual, expected):
    return {
        name: float((actual[name] - expected[name]).norm() / expected[name].norm())
        for name in expected
        if expected[name].norm() > 0
    }


CASES = {
    "degree 3": {"count": 250, "coefficients": 16},
    "degree 2 with features": {"count": 250, "coefficients": 9, "features": 2, "seed": 1},
    "degree 1, one body": {
        "count": 60,
        "coefficients": 4,
        "features": 1,
        "num_bodies": 1,
        "seed": 5,
    },
    "degree 0, small and many": {
        "count": 700,
        "coefficients": 1,
        "features": 5,
        "size_px": 1.5,
        "seed": 3,
    },
    "large and opaque": {"count": 120, "coefficients": 1, "size_px": 40.0, "seed": 4},
}
