"""Triangle meshes of the street for simulators: files, and obstacles from LiDAR points.

World frame, z up, metres. Of three ways to a mesh that open3d has, ball pivoting (Bernardini et
al., 1999) is taken: measured on a log (docs/bundle.md) it is as near to held-out points as the
others and, unlike a Poisson surface, nowhere far from what was seen.
"""

import re
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from lidarpainter_models.errors import DataError

SPACING_M = 0.1
"""Obstacles are thinned to a point a cube of this side."""
BALLS = (1.0, 2.0, 4.0)
"""Radii of the balls, in spacings: the last one closes what a LiDAR leaves between its rings."""
LEAST_NEIGHBOURS, LONE_SPACINGS = 4, 3.0
"""Points with fewer others so near are noise."""
NORMAL_REACH_M, NORMAL_POINTS = 0.5, 20
MOST_BYTES = 512 * 2**20
"""Of a mesh that is read: more than ten kilometres of road."""
MOST_HEADER_BYTES = 4096
_VERTEX, _FACE = np.dtype("<f4"), np.dtype([("count", "u1"), ("corner", "<i4", 3)])
Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices and the three corners of every face."""


def obstacle_mesh(points_m: Float[np.ndarray, "points 3"], eye_m: Float[np.ndarray, "3"]) -> Mesh:
    """Triangles through points that stand on the ground.

    Args:
        points_m: the points, in the world.
        eye_m: where they were seen from, about: faces turn to it.
    """
    import open3d

    vector = open3d.utility.Vector3dVector
    cloud = open3d.geometry.PointCloud(vector(np.ascontiguousarray(points_m, float)))
    cloud = cloud.voxel_down_sample(SPACING_M)
    if not cloud.is_empty():
        cloud, _ = cloud.remove_radius_outlier(LEAST_NEIGHBOURS, LONE_SPACINGS * SPACING_M)
    if len(cloud.points) < LEAST_NEIGHBOURS:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    cloud.estimate_normals(
        open3d.geometry.KDTreeSearchParamHybrid(radius=NORMAL_REACH_M, max_nn=NORMAL_POINTS)
    )
    cloud.orient_normals_towards_camera_location(eye_m)
    radii = open3d.utility.DoubleVector([SPACING_M * ball for ball in BALLS])
    mesh = open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii)
    mesh.remove_unreferenced_vertices()
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)


def joined(first: Mesh, second: Mesh) -> Mesh:
    """Two meshes as one."""
    vertices = np.concatenate([first[0], second[0]])
    return vertices, np.concatenate([first[1], second[1] + len(first[0])])


def ply_bytes(mesh: Mesh, comment: str) -> bytes:
    """A mesh as a binary PLY file: float x, y, z, and faces of three corners."""
    vertices, faces = mesh
    rows = np.empty(len(faces), _FACE)
    rows["count"], rows["corner"] = 3, faces
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode("ascii") + np.asarray(vertices, _VERTEX).tobytes() + rows.tobytes()


def mesh_of_ply(content: bytes, name: str) -> Mesh:
    """Read a mesh of anybody, through open3d.

    Raises:
        DataError: it is no PLY file of triangles, or one that is too large or holds no numbers.
    """
    if not content.startswith(b"ply") or len(content) > MOST_BYTES:
        raise DataError(f"{name}: expected a PLY file of at most {MOST_BYTES >> 20} MB")
    claimed = re.findall(rb"^element \w+ (\d{1,20})\s*$", content[:MOST_HEADER_BYTES], re.MULTILINE)
    if sum(map(int, claimed)) > len(content):
        raise DataError(f"{name}: claims more vertices and faces than it has bytes")

    import open3d

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        path.write_bytes(content)
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            mesh = open3d.io.read_triangle_mesh(path)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    if not len(faces) or not np.isfinite(vertices).all():
        raise DataError(f"{name}: holds no triangles, or vertices that are no numbers")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DataError(f"{name}: a face names a vertex that is not there")
    return vertices, faces
