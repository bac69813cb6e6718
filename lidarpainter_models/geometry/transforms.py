"""Rigid transforms as 4x4 matrices, named `target_from_source`.

Rotations are unit quaternions with the scalar first (w, x, y, z) or 3x3 matrices. Angles are
radians, lengths metres. Tangent vectors are (rotation vector, translation), six numbers.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError


def transform_points(
    target_from_source: Float[Tensor, "4 4"], points_source: Float[Tensor, "points 3"]
) -> Float[Tensor, "points 3"]:
    """Express source-frame points in the target frame."""
    rotation, translation = target_from_source[:3, :3], target_from_source[:3, 3]
    return points_source @ rotation.T + translation


def invert_rigid(target_from_source: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Give `source_from_target` without a general matrix inverse."""
    rotation = target_from_source[..., :3, :3].transpose(-1, -2)
    translation = -(rotation @ target_from_source[..., :3, 3:])
    return rigid_from_rotation(rotation, translation[..., 0])


def rigid_from_rotation(
    rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Stack a rotation matrix and a translation (metres) into a 4x4 transform."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 0, 3] = 1.0
    return torch.cat([top, bottom], dim=-2)


def rotation_from_quaternion(
    rotation_wxyz: Float[Tensor, "*batch 4"],
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions, which are normalised first."""
    w, x, y, z = torch.nn.functional.normalize(rotation_wxyz, dim=-1).unbind(-1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=-1,
    ).unflatten(-1, (3, 3))


def quaternion_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions (w >= 0) of rotation matrices.

    Of the four candidate formulas the one with the largest divisor is taken (Shepperd, 1978).
    """
    r = rotation
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    squares = torch.stack([trace, r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]], dim=-1)
    a, b, c = r[..., 2, 1], r[..., 0, 2], r[..., 1, 0]
    d, e, f = r[..., 1, 2], r[..., 2, 0], r[..., 0, 1]
    diagonal = 1 + 2 * squares - trace[..., None]
    diagonal = torch.cat([1 + trace[..., None], diagonal[..., 1:]], dim=-1)
    rows = torch.stack(
        [
            torch.stack([diagonal[..., 0], a - d, b - e, c - f], dim=-1),
            torch.stack([a - d, diagonal[..., 1], f + c, b + e], dim=-1),
            torch.stack([b - e, f + c, diagonal[..., 2], a + d], dim=-1),
            torch.stack([c - f, b + e, a + d, diagonal[..., 3]], dim=-1),
        ],
        dim=-2,
    )
    best = diagonal.argmax(dim=-1)
    quaternion = rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    quaternion = torch.nn.functional.normalize(quaternion, dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def rotation_from_vector(
    rotation_vector_rad: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation about a vector by its length: the exponential map of SO(3), smooth at zero.

    Rodrigues' formula, its factors as sinc: a fit asks for it several times a step.
    """
    x, y, z = rotation_vector_rad.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    turns = torch.linalg.vector_norm(rotation_vector_rad, dim=-1)[..., None, None] / math.pi
    identity = torch.eye(3, dtype=skew.dtype, device=skew.device)
    half = torch.sinc(0.5 * turns)
    return identity + torch.sinc(turns) * skew + 0.5 * half * half * (skew @ skew)


def rotation_about_up(yaw_rad: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation about the world's up axis, counter-clockwise."""
    cosine, sine = yaw_rad.cos(), yaw_rad.sin()
    zero, one = torch.zeros_like(yaw_rad), torch.ones_like(yaw_rad)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, one]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rigid_from_tangent(tangent: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Small transform from (rotation vector in radians, translation in metres)."""
    return rigid_from_rotation(rotation_from_vector(tangent[..., :3]), tangent[..., 3:])


def turn_rad(
    first: Float[Tensor, "*batch 4 4"], second: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch"]:
    """Angle between the rotations of poses."""
    turn = first[..., :3, :3].mT @ second[..., :3, :3]
    return 2 * torch.arccos(quaternion_from_rotation(turn)[..., 0].clamp(max=1.0))


def interpolate_rigid(
    world_from_first: Float[Tensor, "*batch 4 4"],
    world_from_second: Float[Tensor, "*batch 4 4"],
    fraction: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 4 4"]:
    """Move from the first pose (0) to the second (1): slerp the rotation, mix the translation.

    A fraction outside [0, 1] continues the same motion.
    """
    first = quaternion_from_rotation(world_from_first[..., :3, :3])
    second = quaternion_from_rotation(world_from_second[..., :3, :3])
    cosine = (first * second).sum(-1)
    second = torch.where(cosine[..., None] < 0, -second, second)
    angle = torch.arccos(cosine.abs().clamp(max=1.0))
    is_small = angle < 1e-6
    sine = torch.where(is_small, torch.ones_like(angle), torch.sin(angle))
    weight_first = torch.where(is_small, 1 - fraction, torch.sin((1 - fraction) * angle) / sine)
    weight_second = torch.where(is_small, fraction, torch.sin(fraction * angle) / sine)
    quaternion = weight_first[..., None] * first + weight_second[..., None] * second
    mix = fraction[..., None]
    translation = (1 - mix) * world_from_first[..., :3, 3] + mix * world_from_second[..., :3, 3]
    return rigid_from_rotation(rotation_from_quaternion(quaternion), translation)


def interpolate_rigid_track(
    timestamps_ns: torch.Tensor, world_from_body: Float[Tensor, "times 4 4"], query_ns: int
) -> Float[Tensor, "4 4"]:
    """Pose of a track (ascending times) at one time; beyond its ends the end pose holds.

    Raises:
        ShapeError: the track is empty or its times and poses differ in number.
    """
    if timestamps_ns.numel() == 0 or timestamps_ns.numel() != world_from_body.shape[0]:
        raise ShapeError(
            f"a track needs one pose per time, got {timestamps_ns.numel()} times and "
            f"{world_from_body.shape[0]} poses"
        )
    after = int(torch.searchsorted(timestamps_ns, query_ns))
    if after == 0:
        return world_from_body[0]
    if after == timestamps_ns.numel():
        return world_from_body[-1]
    start_ns, end_ns = int(timestamps_ns[after - 1]), int(timestamps_ns[after])
    fraction = (query_ns - start_ns) / (end_ns - start_ns)
    return interpolate_rigid(
        world_from_body[after - 1],
        world_from_body[after],
        torch.tensor(fraction, dtype=world_from_body.dtype),
    )


def is_rigid(target_from_source: Float[Tensor, "*batch 4 4"]) -> Bool[Tensor, "*batch"]:
    """Whether each matrix is finite, a right-handed rotation plus a translation, up to rounding."""
    tolerance = 1e-4
    finite = torch.isfinite(target_from_source).all(-1).all(-1)
    rotation = target_from_source[..., :3, :3]
    gram = rotation @ rotation.transpose(-1, -2)
    identity = torch.eye(3, dtype=gram.dtype, device=gram.device)
    orthogonal = ((gram - identity).abs() < tolerance).all(-1).all(-1)
    last_row = torch.tensor([0, 0, 0, 1], dtype=gram.dtype, device=gram.device)
    affine = ((target_from_source[..., 3, :] - last_row).abs() < tolerance).all(-1)
    return finite & orthogonal & affine & (torch.linalg.det(rotation.nan_to_num()) > 0)
