"""Kinds of cars: outlines, windows and wheels in metres, x from the middle towards the nose."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class CarShape:
    """Profile of a kind of car: (x, z) points in metres, x from the middle towards the nose."""

    category: str
    length_m: float
    width_m: float
    roof: tuple[tuple[float, float], ...]
    """Upper outline from tail to nose."""
    belt: tuple[tuple[float, float], ...]
    """Lower edge of the windows, meeting the outline at hood and trunk."""
    wheel_radius_m: float
    wheel_x_m: tuple[float, float]
    glass: tuple[float, float, float, float]
    """x of rear base, rear top, windscreen top and windscreen base."""
    pillars: tuple[float, ...]
    """x of the pillars between side windows."""

    @property
    def height_m(self) -> float:
        """Height of the roof above the ground."""
        return max(z for _, z in self.roof)


SHAPES: dict[str, CarShape] = {
    "sedan": CarShape(
        category="car", length_m=4.7, width_m=1.82,
        roof=((-2.35, 0.86), (-2.28, 0.99), (-1.72, 1.05), (-1.0, 1.39), (-0.45, 1.45),
              (0.2, 1.42), (1.05, 1.02), (1.9, 0.86), (2.25, 0.74), (2.35, 0.62)),
        belt=((-2.35, 0.80), (-1.8, 0.97), (1.05, 0.92), (1.9, 0.80), (2.35, 0.58)),
        wheel_radius_m=0.33, wheel_x_m=(-1.38, 1.42), glass=(-1.66, -0.98, 0.22, 1.02),
        pillars=(-0.98, -0.16),
    ),
    "hatch": CarShape(
        category="car", length_m=4.1, width_m=1.76,
        roof=((-2.05, 0.84), (-2.0, 1.0), (-1.62, 1.42), (-0.9, 1.51), (0.2, 1.48),
              (1.0, 1.04), (1.7, 0.90), (2.0, 0.74), (2.05, 0.62)),
        belt=((-2.05, 0.80), (-1.9, 0.98), (1.0, 0.94), (1.7, 0.84), (2.05, 0.58)),
        wheel_radius_m=0.32, wheel_x_m=(-1.26, 1.26), glass=(-1.95, -1.6, 0.22, 0.98),
        pillars=(-1.1, -0.25),
    ),
    "suv": CarShape(
        category="car", length_m=4.75, width_m=1.92,
        roof=((-2.37, 0.95), (-2.3, 1.12), (-2.05, 1.66), (-1.3, 1.75), (0.1, 1.73),
              (0.95, 1.2), (1.95, 1.06), (2.28, 0.92), (2.37, 0.72)),
        belt=((-2.37, 0.92), (-2.2, 1.12), (0.95, 1.09), (1.95, 1.0), (2.37, 0.66)),
        wheel_radius_m=0.38, wheel_x_m=(-1.42, 1.45), glass=(-2.28, -2.02, 0.12, 0.93),
        pillars=(-1.28, -0.2),
    ),
    "van": CarShape(
        category="van", length_m=5.3, width_m=2.02,
        roof=((-2.65, 1.1), (-2.6, 1.9), (-2.45, 2.28), (-1.0, 2.36), (0.9, 2.3),
              (1.65, 1.32), (2.3, 1.12), (2.6, 0.9), (2.65, 0.7)),
        belt=((-2.65, 1.05), (-2.5, 1.3), (1.65, 1.24), (2.3, 1.05), (2.65, 0.66)),
        wheel_radius_m=0.35, wheel_x_m=(-1.6, 1.75), glass=(-2.6, -2.48, 0.95, 1.63),
        pillars=(-0.4, 0.35),
    ),
    "pickup": CarShape(
        category="pickup", length_m=5.4, width_m=1.98,
        roof=((-2.7, 0.98), (-2.66, 1.1), (-0.98, 1.12), (-0.82, 1.7), (-0.6, 1.8),
              (0.35, 1.78), (1.12, 1.22), (2.2, 1.1), (2.6, 0.95), (2.7, 0.74)),
        belt=((-2.7, 0.96), (-2.6, 1.09), (1.12, 1.1), (2.2, 1.03), (2.7, 0.68)),
        wheel_radius_m=0.4, wheel_x_m=(-1.62, 1.72), glass=(-1.0, -0.8, 0.38, 1.1),
        pillars=(-0.1,),
    ),
}  # fmt: skip
