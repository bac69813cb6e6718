"""Pack meshes, surfaces and light into the arrays that are traced."""

import numpy as np

from lidarpainter_models.synthetic.raytracing import scene_arrays as layout
from lidarpainter_models.synthetic.textures.surfaces import (
    SurfaceSet,
    linear_from_srgb,
    srgb_from_linear,
)
from lidarpainter_models.synthetic.world.meshes import Mesh

Triple = tuple[float, float, float]


def light_array(
    sun_direction: Triple,
    *,
    sun_rgb: Triple,
    haze_per_m: float,
    cloud_texture: int,
    cloud_offset: tuple[float, float],
) -> np.ndarray:
    """Sun, sky and air as `SceneArrays.light`; colours are linear."""
    array = np.zeros(layout.LIGHT_COLUMNS)
    array[layout.SUN_DIRECTION : layout.SUN_DIRECTION + 3] = sun_direction
    array[layout.SUN_RGB : layout.SUN_RGB + 3] = sun_rgb
    array[layout.ZENITH_RGB : layout.ZENITH_RGB + 3] = 0.30, 0.45, 0.74
    array[layout.HORIZON_RGB : layout.HORIZON_RGB + 3] = 0.74, 0.80, 0.88
    array[layout.GROUND_RGB : layout.GROUND_RGB + 3] = 0.26, 0.24, 0.21
    array[layout.HAZE_PER_M] = haze_per_m
    array[layout.CLOUD_TEXTURE] = cloud_texture
    array[layout.EXPOSURE] = 0.86
    array[layout.CLOUD_OFFSET : layout.CLOUD_OFFSET + 2] = cloud_offset
    return array


def pack_scene(
    street: Mesh,
    street_actor: np.ndarray,
    moving: list[tuple[Mesh, int]],
    surfaces: SurfaceSet,
    light: np.ndarray,
) -> tuple[layout.SceneArrays, np.ndarray, np.ndarray]:
    """Everything a ray needs.

    The street stands still, in the world; `street_actor` (primitives) is the actor index of each of
    its primitives, -1 for none. Moving meshes, with their actors, are in their box frames.

    Returns:
        The arrays, and the root node (int32) and radius (metres) of every moving mesh.
    """
    value, index = surfaces.surface_arrays()
    texels, texture_index = surfaces.texture_arrays()
    meshes = [(street, street_actor)]
    meshes += [(mesh, np.full(len(mesh.surface), actor)) for mesh, actor in moving]
    trees, roots, num_nodes, num_prims = [], [], 0, 0
    for mesh, actor in meshes:
        tree = _pack_tree(mesh, actor, index, num_nodes, num_prims)
        trees.append(tree)
        roots.append(num_nodes)
        num_nodes += tree[0].shape[0]
        num_prims += tree[2].shape[0]
    bounds, children, geometry, shading, owner = map(np.concatenate, zip(*trees, strict=True))
    arrays = layout.SceneArrays(
        node_bounds=bounds,
        node_children=children,
        prim_geometry=geometry,
        prim_shading=shading,
        prim_index=owner,
        surface_value=value,
        surface_index=index,
        texels=texels,
        texture_index=texture_index,
        light=light,
        to_linear=linear_from_srgb(np.arange(256) / 255).astype(np.float32),
        to_display=_tone_curve(),
    )
    radii = [np.linalg.norm(mesh.corners(), axis=-1).max() + 0.01 for mesh, _ in moving]
    return arrays, np.array(roots[1:], np.int32), np.array(radii, np.float64)


def lone_scene(whole: layout.SceneArrays, mesh: Mesh) -> layout.SceneArrays:
    """A scene in the light of another one, of nothing but a mesh of its surfaces; actor 0."""
    owner = np.zeros(len(mesh.surface), np.int64)
    bounds, children, geometry, shading, index = _pack_tree(mesh, owner, whole.surface_index, 0, 0)
    return whole._replace(
        node_bounds=bounds,
        node_children=children,
        prim_geometry=geometry,
        prim_shading=shading,
        prim_index=index,
    )


def _pack_tree(
    mesh: Mesh, actor: np.ndarray, surface_index: np.ndarray, num_nodes: int, num_prims: int
) -> tuple[np.ndarray, ...]:
    """Nodes and primitives of one mesh, numbered on from what is there."""
    corners = mesh.corners()
    margin = 1e-4
    from lidarpainter_models.synthetic.raytracing.bvh import build_tree  # numba

    bounds, children, order = build_tree(
        (corners.min(1) - margin).astype(np.float32), (corners.max(1) + margin).astype(np.float32)
    )
    is_leaf = children < 0
    leaf = -children - 1
    moved = -(leaf + num_prims * 8) - 1
    children = np.where(is_leaf, np.where(leaf & 7, moved, -1), children + num_nodes)
    geometry = mesh.geometry[order].astype(np.float32)
    kinds = surface_index[mesh.surface[order], layout.KIND]
    geometry[:, layout.IS_CUT_OUT] = kinds == layout.KIND_CUT_OUT
    owner = np.stack([mesh.surface[order], actor[order]], axis=1).astype(np.int32)
    shading = mesh.shading[order].astype(np.float32)
    return bounds, children.astype(np.int32), geometry, shading, owner


def _tone_curve() -> np.ndarray:
    """Image value of exposed light: sRGB with a shoulder above 0.6 that ends at 1."""
    light = np.linspace(0, layout.DISPLAY_LIMIT, 4096)
    knee = 0.6
    over = np.maximum(light - knee, 0)
    compressed = np.where(light < knee, light, knee + (1 - knee) * (1 - np.exp(-over / (1 - knee))))
    return srgb_from_linear(compressed).astype(np.float32)
