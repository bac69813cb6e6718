"""Street trees and hedges: trunks, branches, and crowns of leafy cards with cut-out leaves."""

from dataclasses import replace

import cv2
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import KIND_CUT_OUT
from lidarpainter_models.synthetic.textures.noise import as_rgba, fractal_noise
from lidarpainter_models.synthetic.textures.surfaces import StreetClass, Surface, SurfaceSet
from lidarpainter_models.synthetic.world.meshes import MeshBuilder, Vector
from lidarpainter_models.synthetic.world.solids import add_tube

SPECIES = ((58, 92, 34), (76, 104, 40), (44, 78, 40), (104, 112, 44), (66, 88, 52))
DEPTHS = (0.42, 0.72, 1.0)
LeafSurfaces = tuple[int, ...]
"""Surfaces of the leaves of one species, from the shaded inside to the outside."""


def draw_leaves(rng: np.random.Generator, colour: tuple[int, int, int]) -> np.ndarray:
    """A bunch of leaves as a cut-out."""
    size = 160
    image = np.full((size, size, 3), np.array(colour) * 0.7, np.float32)
    opacity = np.zeros((size, size), np.uint8)
    for _ in range(120):
        radius = 0.44 * size * np.sqrt(rng.random())
        angle = rng.uniform(0, 2 * np.pi)
        centre = int(size / 2 + radius * np.cos(angle)), int(size / 2 + radius * np.sin(angle))
        axes = int(rng.uniform(6, 11)), int(rng.uniform(3, 5))
        turn = float(np.rad2deg(angle) + rng.normal(0, 40))
        tone = np.array(colour) * rng.uniform(0.62, 1.3) + rng.normal(0, 6, 3)
        shade = tuple(float(c) for c in np.clip(tone, 8, 255))
        cv2.ellipse(image, centre, axes, turn, 0, 360, shade, -1, cv2.LINE_AA)
        cv2.ellipse(opacity, centre, axes, turn, 0, 360, 255, -1, cv2.LINE_AA)
    return as_rgba(image, opacity / 255)


def add_species(
    surfaces: SurfaceSet, rng: np.random.Generator, colour: tuple[int, int, int]
) -> LeafSurfaces:
    """Textures and surfaces of one kind of leaves."""
    texture = surfaces.add_texture(draw_leaves(rng, colour))
    leaf = Surface(
        semantics=StreetClass.VEGETATION, texture=texture, kind=KIND_CUT_OUT, translucency=0.55
    )
    return tuple(surfaces.add(replace(leaf, tint=(depth, depth, depth))) for depth in DEPTHS)


def bark_surface(surfaces: SurfaceSet, rng: np.random.Generator) -> int:
    """Brown bark with ridges."""
    ridges = fractal_noise(rng, (128, 64), (6, 12), octaves=4)
    tone = 0.45 + 0.8 * ridges
    bark = as_rgba(tone[..., None] * np.array([96, 80, 64.0]))
    return surfaces.painted(bark, StreetClass.VEGETATION, repeats=True)


def add_crown(
    builder: MeshBuilder,
    centre: Vector,
    radii: Vector,
    leaves: LeafSurfaces,
    rng: np.random.Generator,
    *,
    num_cards: int,
    card_m: float,
) -> None:
    """Cards scattered around clusters in an ellipsoid, lit as if the crown were round."""
    centre, radii = np.asarray(centre, float), np.asarray(radii, float)
    num_clusters = max(num_cards // 18, 3)
    heads = rng.normal(size=(num_clusters, 3))
    heads /= np.linalg.norm(heads, axis=1, keepdims=True)
    heads *= rng.uniform(0.35, 0.86, (num_clusters, 1))
    chosen = rng.integers(num_clusters, size=num_cards)
    spots = heads[chosen] + rng.normal(0, 0.17, (num_cards, 3))
    depth = np.linalg.norm(spots, axis=1)
    spots /= np.maximum(depth / 1.03, 1.0)[:, None]
    outward = spots + 0.7 * (spots - heads[chosen]) / 0.17 * 0.25 + np.array([0, 0, 0.15])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-9
    first = rng.normal(size=(num_cards, 3))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(first, rng.normal(size=(num_cards, 3)))
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    size = card_m * rng.uniform(0.75, 1.25, (num_cards, 1))
    corner = centre + spots * radii - 0.5 * size * (first + second)
    corners = np.stack([corner, corner + size * first, corner + size * second], axis=1)
    uv = np.broadcast_to(np.array([[0, 0], [1, 0], [0, 1.0]]), (num_cards, 3, 2))
    low = 0.55 * np.minimum(depth, 1.0) + 0.3 * (spots[:, 2] + 1) / 2
    shade = np.clip((low + rng.normal(0, 0.08, num_cards)) * 3.4 - 0.6, 0, 2.99).astype(int)
    normals = np.repeat(outward[:, None], 3, axis=1)
    surface = np.array(leaves)[shade]
    builder.primitives(corners, uv, surface, normals=normals, is_parallelogram=True)


def add_tree(
    builder: MeshBuilder,
    foot: np.ndarray,
    leaves: LeafSurfaces,
    bark: int,
    rng: np.random.Generator,
    *,
    detail: float,
) -> None:
    """A street tree; `detail` scales the number of cards, which grow as they get fewer."""
    height = rng.uniform(2.3, 3.2)
    lean = rng.normal(0, 0.08, 2)
    fork = foot + np.array([lean[0], lean[1], height])
    girth = rng.uniform(0.09, 0.16)
    add_tube(builder, foot - [0, 0, 0.1], fork, (girth, 0.75 * girth), bark, sides=8)
    radii = np.array([1.0, 1.0, rng.uniform(0.85, 1.25)]) * rng.uniform(1.35, 2.1)
    centre = fork + np.array([0, 0, 0.62 * radii[2]])
    for _ in range(5):
        tip = centre + rng.normal(0, 0.5, 3) * radii * [0.8, 0.8, 0.5]
        add_tube(builder, fork - [0, 0, 0.15], tip, (0.5 * girth, 0.02), bark, sides=5)
    num_cards = int(330 * detail * radii[0] / 1.7)
    card_m = 0.72 * (radii[0] / 1.7) / np.sqrt(max(detail, 0.05)) ** 0.8
    add_crown(builder, centre, radii, leaves, rng, num_cards=num_cards, card_m=card_m)


def add_hedge(
    builder: MeshBuilder,
    start: np.ndarray,
    end: np.ndarray,
    leaves: LeafSurfaces,
    rng: np.random.Generator,
) -> None:
    """A row of low bushes."""
    length = float(np.linalg.norm(end - start))
    for along in np.arange(0.5, length, 0.9):
        place = start + (end - start) * along / length
        radii = np.array([0.65, 0.65, 0.7]) * rng.uniform(0.8, 1.2)
        centre = place + np.array([0, 0, 0.5])
        add_crown(builder, centre, radii, leaves, rng, num_cards=55, card_m=0.42)
