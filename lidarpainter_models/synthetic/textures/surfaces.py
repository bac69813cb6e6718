"""What things are made of: textures with their pyramids, surfaces, and the classes of the street.

Textures are drawn as RGBA bytes in sRGB. The fourth channel means opacity on cut-out surfaces, the
share of paint on roads and gloss elsewhere.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import cv2
import numpy as np

from lidarpainter_models.synthetic.raytracing import scene_arrays as layout


class StreetClass(IntEnum):
    """Classes of the truth images and of the LiDAR points."""

    SKY = 0
    ROAD = 1
    LANE_MARKING = 2
    SIDEWALK = 3
    BUILDING = 4
    VEGETATION = 5
    POLE = 6
    SIGN = 7
    CAR = 8
    PEDESTRIAN = 9
    FURNITURE = 10
    TERRAIN = 11


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values, both 0..1 (IEC 61966-2-1)."""
    value = np.asarray(value, float)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(value: np.ndarray) -> np.ndarray:
    """The inverse of `linear_from_srgb`."""
    value = np.asarray(value, float)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)


def tint_from_bytes(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    """Linear tint of an sRGB colour given as bytes."""
    red, green, blue = linear_from_srgb(np.array(colour) / 255.0)
    return float(red), float(green), float(blue)


@dataclass(frozen=True, kw_only=True)
class Surface:
    """How a primitive looks."""

    semantics: StreetClass
    texture: int = 0
    """0 is plain white."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear."""
    kind: int = layout.KIND_GLOSS
    gloss: float = 0.0
    """Share of the mirrored light; times the fourth channel where that means gloss."""
    emission: float = 0.0
    detail_texture: int = -1
    detail_per_m: float = 0.5
    detail_strength: float = 0.0
    translucency: float = 0.0
    lamp: int = -1
    """Whose emission it is: column of `InstanceArrays.is_lit`, -1 where it never changes."""


@dataclass(eq=False)
class SurfaceSet:
    """Collects textures and surfaces of one street."""

    surfaces: list[Surface] = field(default_factory=list)
    _levels: list[list[np.ndarray]] = field(default_factory=list)
    _repeats: list[bool] = field(default_factory=list)
    _known: dict[Surface, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.add_texture(np.full((1, 1, 4), 255, np.uint8))

    def add_texture(self, rgba: np.ndarray, *, repeats: bool = False) -> int:
        """Keep an RGBA image with all its smaller levels; gives its index."""
        if rgba.dtype != np.uint8 or rgba.ndim != 3 or rgba.shape[2] != 4:
            raise ValueError(f"a texture is uint8 (height, width, 4), got {rgba.shape}")
        self._levels.append(_pyramid(rgba))
        self._repeats.append(repeats)
        return len(self._levels) - 1

    def add(self, surface: Surface) -> int:
        """Index of a surface; equal ones share it."""
        if surface not in self._known:
            self._known[surface] = len(self.surfaces)
            self.surfaces.append(surface)
        return self._known[surface]

    def plain(
        self,
        colour: tuple[int, int, int],
        semantics: StreetClass,
        **looks: Any,  # noqa: ANN401 - fields of `Surface`
    ) -> int:
        """Index of a surface of one sRGB colour, given as bytes."""
        return self.add(Surface(semantics=semantics, tint=tint_from_bytes(colour), **looks))

    def painted(
        self,
        rgba: np.ndarray,
        semantics: StreetClass,
        *,
        repeats: bool = False,
        **looks: Any,  # noqa: ANN401 - fields of `Surface`
    ) -> int:
        """Index of a surface that shows an image."""
        texture = self.add_texture(rgba, repeats=repeats)
        return self.add(Surface(semantics=semantics, texture=texture, **looks))

    def texture_arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """`texels` and `texture_index` of `SceneArrays`."""
        index = np.zeros((len(self._levels), layout.LEVEL_OFFSET + layout.MAX_LEVELS), np.int32)
        texels, offset = [], 0
        for row, (levels, repeats) in enumerate(zip(self._levels, self._repeats, strict=True)):
            height, width = levels[0].shape[:2]
            index[row, : layout.LEVEL_OFFSET] = width, height, repeats, len(levels)
            for level, image in enumerate(levels):
                index[row, layout.LEVEL_OFFSET + level] = offset
                offset += image.shape[0] * image.shape[1]
                texels.append(image.reshape(-1, 4))
        return np.concatenate(texels), index

    def surface_arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """`surface_value` and `surface_index` of `SceneArrays`."""
        value = np.zeros((len(self.surfaces), layout.VALUE_COLUMNS), np.float32)
        index = np.zeros((len(self.surfaces), layout.INDEX_COLUMNS), np.int32)
        for row, surface in enumerate(self.surfaces):
            value[row] = (
                *surface.tint,
                surface.gloss,
                surface.emission,
                surface.detail_per_m,
                surface.detail_strength,
                surface.translucency,
            )
            index[row] = (
                surface.texture,
                surface.detail_texture,
                surface.kind,
                surface.semantics,
                surface.lamp,
            )
        return value, index


_TO_LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
_LINEAR_RGBA: Any = np.stack(
    [*[_TO_LINEAR] * 3, (np.arange(256) / np.float32(255)).astype(np.float32)], axis=1
)[None]
_TO_BYTE = np.rint(srgb_from_linear(np.arange(4096) / 4095.0) * 255).astype(np.uint8)


def _pyramid(rgba: np.ndarray) -> list[np.ndarray]:
    """Levels of halved size, averaged in linear light; sizes round down like the sampler's."""
    levels = [np.ascontiguousarray(rgba)]
    linear: np.ndarray = cv2.LUT(levels[0], _LINEAR_RGBA)
    while max(linear.shape[:2]) > 1 and len(levels) < layout.MAX_LEVELS:
        level = len(levels)
        size = (max(rgba.shape[1] >> level, 1), max(rgba.shape[0] >> level, 1))
        linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], 4)
        image = np.empty(linear.shape, np.uint8)
        np.take(_TO_BYTE, (linear[..., :3] * 4095 + 0.5).astype(np.uint16), out=image[..., :3])
        image[..., 3] = linear[..., 3] * 255 + 0.5
        levels.append(image)
    return levels
