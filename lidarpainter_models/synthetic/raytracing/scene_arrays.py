"""The flat arrays a street is traced from, and what their columns mean.

Numba functions take these tuples of NumPy arrays. World: x forward, y left, z up, metres; colours
are linear light unless a name says otherwise.
"""

from typing import NamedTuple

import numpy as np

# prim_geometry: corner (0-2), first edge (3-5), second edge (6-8), then
IS_PARALLELOGRAM = 9
IS_CUT_OUT = 10
GEOMETRY_COLUMNS = 12

# prim_shading: normal at the corner and its change along each edge (0-8), then uv alike
UV_CORNER = 9
UV_FIRST = 11
UV_SECOND = 13
SHADING_COLUMNS = 15

# prim_index
SURFACE = 0
ACTOR = 1

# surface_value
TINT = 0
GLOSS = 3
EMISSION = 4
DETAIL_PER_M = 5
DETAIL_STRENGTH = 6
TRANSLUCENCY = 7
VALUE_COLUMNS = 8

# surface_index
TEXTURE = 0
DETAIL_TEXTURE = 1
KIND = 2
SEMANTICS = 3
LAMP = 4
INDEX_COLUMNS = 5

# kinds of surface: what the fourth channel of the texture means
KIND_GLOSS = 0
KIND_CUT_OUT = 1
KIND_ROAD = 2

MAX_LEVELS = 14
# texture_index: width, height, repeats, number of levels, then the first texel of every level
LEVEL_OFFSET = 4

# light
SUN_DIRECTION = 0
SUN_RGB = 3
ZENITH_RGB = 6
HORIZON_RGB = 9
GROUND_RGB = 12
HAZE_PER_M = 15
CLOUD_TEXTURE = 16
EXPOSURE = 17
CLOUD_OFFSET = 18
LIGHT_COLUMNS = 20


class SceneArrays(NamedTuple):
    """Everything that does not change with time or view."""

    node_bounds: np.ndarray
    """float32 (nodes, 12): lower and upper corner of the left child, then of the right one."""
    node_children: np.ndarray
    """int32 (nodes, 2): a node, or a leaf as -(first * 8 + count) - 1."""
    prim_geometry: np.ndarray
    """float32 (primitives, GEOMETRY_COLUMNS)."""
    prim_shading: np.ndarray
    """float32 (primitives, SHADING_COLUMNS)."""
    prim_index: np.ndarray
    """int32 (primitives, 2): surface, actor (-1 none)."""
    surface_value: np.ndarray
    """float32 (surfaces, VALUE_COLUMNS)."""
    surface_index: np.ndarray
    """int32 (surfaces, INDEX_COLUMNS); the lamp is a column of `is_lit`, -1 for none."""
    texels: np.ndarray
    """uint8 (texels, 4): sRGB and the fourth channel, every level of every texture."""
    texture_index: np.ndarray
    """int32 (textures, LEVEL_OFFSET + MAX_LEVELS)."""
    light: np.ndarray
    """float64 (LIGHT_COLUMNS)."""
    to_linear: np.ndarray
    """float32 (256): linear light of an sRGB byte."""
    to_display: np.ndarray
    """float32 (4096): image value of exposed light between 0 and DISPLAY_LIMIT."""


DISPLAY_LIMIT = 8.0


class InstanceArrays(NamedTuple):
    """The moving objects and the lamps at one or more times."""

    roots: np.ndarray
    """int32 (times, instances): root node of each one's own tree; that of a walker changes."""
    radius_m: np.ndarray
    """float64 (instances): of the ball around the box origin that holds the mesh."""
    world_from_box: np.ndarray
    """float64 (times, instances, 3, 4)."""
    contact: np.ndarray
    """float64 (times, vehicles, 6): centre x y, cos and sin of heading, half length and width of
    everything that darkens the ground it stands on."""
    is_lit: np.ndarray
    """float32 (times, lamps): 1 where a lamp is on, 0 where it is off."""


class ViewArrays(NamedTuple):
    """One pinhole view."""

    world_from_camera: np.ndarray
    """float64 (times, 3, 4): one, or one for each row of the image."""
    intrinsics: np.ndarray
    """float64 (4): fx, fy, cx, cy in pixels."""
    offsets: np.ndarray
    """float64 (samples, 2): positions in the pixel, symmetric about its centre."""
    footprint_px: float
    """Width of a sample, pixels."""
