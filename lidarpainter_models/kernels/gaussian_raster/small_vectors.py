"""Vectors of three and 3x3 matrices as tuples of lanes, for compiled code on eight Gaussians.

A matrix is a tuple of its rows. Tuples stay in registers; small arrays would go through memory.
"""

import math

import numba

from lidarpainter_models.kernels.gaussian_raster.compilation import EXACT
from lidarpainter_models.kernels.gaussian_raster.lane_types import largest

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Quaternion = tuple[float, float, float, float]
"""Scalar first."""


@numba.njit(**EXACT)
def dot(first: Vector, second: Vector) -> float:
    """Inner product."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@numba.njit(**EXACT)
def add(first: Vector, second: Vector) -> Vector:
    """Sum of two vectors."""
    return (first[0] + second[0], first[1] + second[1], first[2] + second[2])


@numba.njit(**EXACT)
def scaled(vector: Vector, factor: float) -> Vector:
    """Vector times a number."""
    return (vector[0] * factor, vector[1] * factor, vector[2] * factor)


@numba.njit(**EXACT)
def transposed(matrix: Matrix) -> Matrix:
    """Rows become columns."""
    return (
        (matrix[0][0], matrix[1][0], matrix[2][0]),
        (matrix[0][1], matrix[1][1], matrix[2][1]),
        (matrix[0][2], matrix[1][2], matrix[2][2]),
    )


@numba.njit(**EXACT)
def apply(matrix: Matrix, vector: Vector) -> Vector:
    """Matrix times column vector."""
    return (dot(matrix[0], vector), dot(matrix[1], vector), dot(matrix[2], vector))


@numba.njit(**EXACT)
def product(first: Matrix, second: Matrix) -> Matrix:
    """Matrix times matrix."""
    columns = transposed(second)
    return (apply(columns, first[0]), apply(columns, first[1]), apply(columns, first[2]))


@numba.njit(**EXACT)
def outer(column: Vector, row: Vector) -> Matrix:
    """Column vector times row vector."""
    return (scaled(row, column[0]), scaled(row, column[1]), scaled(row, column[2]))


@numba.njit(**EXACT)
def added(first: Matrix, second: Matrix) -> Matrix:
    """Sum of two matrices."""
    return (add(first[0], second[0]), add(first[1], second[1]), add(first[2], second[2]))


@numba.njit(**EXACT)
def rotation_matrix(wxyz: Quaternion) -> Matrix:
    """Rotation of a unit quaternion, scalar first."""
    w, x, y, z = wxyz
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@numba.njit(**EXACT)
def rotation_gradient(wxyz: Quaternion, gradient: Matrix) -> Quaternion:
    """Gradient of the unit quaternion from that of its rotation matrix."""
    w, x, y, z = wxyz
    (g00, g01, g02), (g10, g11, g12), (g20, g21, g22) = gradient
    return (
        2.0 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01)),
        2.0 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2.0 * x * (g11 + g22)),
        2.0 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2.0 * y * (g00 + g22)),
        2.0 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2.0 * z * (g00 + g11)),
    )


@numba.njit(**EXACT)
def direction_of(vector: Vector) -> tuple[Vector, float]:
    """Unit vector along `vector`, and the length it was divided by."""
    length = largest(math.sqrt(dot(vector, vector)), 1e-12)
    return scaled(vector, 1.0 / length), length


@numba.njit(**EXACT)
def direction_of_gradient(unit: Vector, length: float, gradient: Vector) -> Vector:
    """Gradient of a vector from that of the unit vector along it."""
    across = add(gradient, scaled(unit, -dot(unit, gradient)))
    return scaled(across, 1.0 / length)
