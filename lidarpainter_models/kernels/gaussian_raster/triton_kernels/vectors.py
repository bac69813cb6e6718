"""Vectors, matrices (three rows) and quaternions of tensors, one number for each lane.

The same mathematics as `small_vectors`, for Triton.
"""

import triton
import triton.language as tl


@triton.jit
def load_vector(pointer, index, mask, other):
    """Rows of three as float64."""
    start = pointer + 3 * index.to(tl.int64)
    return (
        tl.load(start, mask=mask, other=other).to(tl.float64),
        tl.load(start + 1, mask=mask, other=other).to(tl.float64),
        tl.load(start + 2, mask=mask, other=other).to(tl.float64),
    )


@triton.jit
def add_vector(pointer, index, mask, vector):
    """Add to rows of three float32, in float32."""
    start = pointer + 3 * index.to(tl.int64)
    for axis in tl.static_range(3):
        before = tl.load(start + axis, mask=mask, other=0.0)
        tl.store(start + axis, before + vector[axis].to(tl.float32), mask=mask)


@triton.jit
def load_pose(camera_from_body, body, mask):
    """Rotation rows and translation of bodies; those of masked lanes are zero."""
    start = camera_from_body + 16 * body.to(tl.int64)
    rotation = (_row(start, mask), _row(start + 4, mask), _row(start + 8, mask))
    translation = (
        tl.load(start + 3, mask=mask, other=0.0),
        tl.load(start + 7, mask=mask, other=0.0),
        tl.load(start + 11, mask=mask, other=0.0),
    )
    return rotation, translation


@triton.jit
def _row(start, mask):
    return (
        tl.load(start, mask=mask, other=0.0),
        tl.load(start + 1, mask=mask, other=0.0),
        tl.load(start + 2, mask=mask, other=0.0),
    )


@triton.jit
def dot(first, second):
    """Sum of products."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@triton.jit
def add(first, second):
    """Sum of two vectors."""
    return (first[0] + second[0], first[1] + second[1], first[2] + second[2])


@triton.jit
def scaled(vector, factor):
    """Vector times number."""
    return (vector[0] * factor, vector[1] * factor, vector[2] * factor)


@triton.jit
def apply(matrix, vector):
    """Matrix times column vector."""
    return (dot(matrix[0], vector), dot(matrix[1], vector), dot(matrix[2], vector))


@triton.jit
def transposed(matrix):
    """Columns as rows."""
    return (
        (matrix[0][0], matrix[1][0], matrix[2][0]),
        (matrix[0][1], matrix[1][1], matrix[2][1]),
        (matrix[0][2], matrix[1][2], matrix[2][2]),
    )


@triton.jit
def product(first, second):
    """Matrix times matrix."""
    columns = transposed(second)
    return (apply(columns, first[0]), apply(columns, first[1]), apply(columns, first[2]))


@triton.jit
def rotation_matrix(w, x, y, z):
    """Rotation of a unit quaternion."""
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@triton.jit
def rotation_gradient(w, x, y, z, g):
    """Gradient of the unit quaternion from that of its rotation matrix."""
    turn_x, turn_y, turn_z = g[2][1] - g[1][2], g[0][2] - g[2][0], g[1][0] - g[0][1]
    both_xy, both_xz, both_yz = g[0][1] + g[1][0], g[0][2] + g[2][0], g[1][2] + g[2][1]
    return (
        2.0 * (x * turn_x + y * turn_y + z * turn_z),
        2.0 * (y * both_xy + z * both_xz + w * turn_x - 2.0 * x * (g[1][1] + g[2][2])),
        2.0 * (x * both_xy + z * both_yz + w * turn_y - 2.0 * y * (g[0][0] + g[2][2])),
        2.0 * (x * both_xz + y * both_yz + w * turn_z - 2.0 * z * (g[0][0] + g[1][1])),
    )
