"""Train the shapes that complete vehicles: distances and materials of streets' cars.

    python scripts/train_vehicle_shapes.py [--without KIND --out FILE]

Writes `lidarpainter_models/lidar/bundled/vehicle_shapes.safetensors` anew, with how it came to be
in its header. Vehicles are the kinds of the synthetic street, each drawn many times with other
proportions, so that no vehicle of a street is among them exactly. Equal code gives equal bytes.
Without a kind, in another file, they tell what shapes are worth for vehicles of no known kind.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_closing, distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from lidarpainter_models.lidar.vehicle_shapes import (
    BUNDLED,
    GRID,
    MATERIALS,
    REACH,
    SHARE_STEP,
    TRUNCATION_M,
)
from lidarpainter_models.storage.tensor_files import write_tensors
from lidarpainter_models.synthetic.plan.car_kinds import SHAPES, CarShape
from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    GLOSS,
    IS_PARALLELOGRAM,
    LEVEL_OFFSET,
    TEXTURE,
    TINT,
    UV_CORNER,
    UV_FIRST,
    UV_SECOND,
)
from lidarpainter_models.synthetic.textures.cars import PAINTS, CarAtlas, add_car_surfaces
from lidarpainter_models.synthetic.textures.surfaces import SurfaceSet, srgb_from_linear
from lidarpainter_models.synthetic.world.car_shapes import build_car
from lidarpainter_models.synthetic.world.meshes import Mesh

SEED = 20_267
OF_EACH_KIND = 30
NUM_AXES, NUM_SHARE_AXES = 12, 6
VOXEL_M = 0.03
NUM_SAMPLES = 400_000
"""Points on a mesh: more than ten for each voxel that it goes through."""
SHARE_THINNING, NUM_NEIGHBOURS = 8, 8
MARKED_PAINT = PAINTS.index((176, 92, 40))
"""Of no other part of a car."""


def varied(shape: CarShape, rng: np.random.Generator) -> CarShape:
    """A kind in other proportions: cabin forward or back, roof, belt, width and wheels."""
    half = shape.length_m / 2
    shift, stretch = rng.normal(0, 0.05, 2) * half
    tall, wide, wheel = np.exp(rng.normal(0, 0.06, 3))

    def along(x: float) -> float:
        share = x / half
        bent = shift * np.cos(share * np.pi / 2) + stretch * np.sin(share * np.pi)
        return float(np.clip(x + bent, -half, half))

    def profile(points: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        return tuple((along(x), 0.5 + (z - 0.5) * tall if z > 0.5 else z) for x, z in points)

    rear_base, rear_top, front_top, front_base = map(along, shape.glass)
    rear, front = map(along, shape.wheel_x_m)
    return replace(
        shape,
        width_m=shape.width_m * wide,
        roof=profile(shape.roof),
        belt=profile(shape.belt),
        wheel_radius_m=shape.wheel_radius_m * wheel,
        wheel_x_m=(rear, front),
        glass=(rear_base, rear_top, front_top, front_base),
        pillars=tuple(map(along, shape.pillars)),
    )


def drawn_from(seed: int, paint: int) -> np.random.Generator:
    """Random numbers of which the first chooses a paint, as `add_car_surfaces` does."""
    while int(np.random.default_rng(seed).integers(len(PAINTS))) != paint:
        seed += 1_000_003
    return np.random.default_rng(seed)


def surface_samples(mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Points (samples, 3) spread evenly over a mesh, their texture places and surfaces."""
    corner, first, second = (mesh.geometry[:, k : k + 3] for k in (0, 3, 6))
    whole = mesh.geometry[:, IS_PARALLELOGRAM] > 0
    area = np.linalg.norm(np.cross(first, second), axis=1) * np.where(whole, 1.0, 0.5)
    rows = rng.choice(len(area), NUM_SAMPLES, p=area / area.sum())
    u, v = rng.random((2, NUM_SAMPLES))
    is_over = (u + v > 1) & ~whole[rows]
    u, v = np.where(is_over, 1 - u, u)[:, None], np.where(is_over, 1 - v, v)[:, None]
    points = corner[rows] + u * first[rows] + v * second[rows]
    uv = [mesh.shading[rows, k : k + 2] for k in (UV_CORNER, UV_FIRST, UV_SECOND)]
    return points, uv[0] + u * uv[1] + v * uv[2], mesh.surface[rows]


def material_of(
    surfaces: SurfaceSet, atlas: CarAtlas, uv: np.ndarray, surface: np.ndarray
) -> np.ndarray:
    """Index in `MATERIALS` (samples), by the colour of a car in `MARKED_PAINT`, and its gloss."""
    value, index = surfaces.surface_arrays()
    texels, where = surfaces.texture_arrays()
    size = where[index[surface, TEXTURE], :2]
    place = np.clip((uv * size).astype(int), 0, size - 1)
    texel = texels[
        where[index[surface, TEXTURE], LEVEL_OFFSET] + place[:, 1] * size[:, 0] + place[:, 0]
    ]
    rgb = texel[:, :3] * srgb_from_linear(value[surface, TINT : TINT + 3].astype(float))
    gloss = texel[:, 3] / 255 * value[surface, GLOSS]
    share = rgb / np.maximum(rgb.sum(1, keepdims=True), 1)
    mark = np.array(PAINTS[MARKED_PAINT], float)
    is_paint = np.abs(share - mark / mark.sum()).max(1) < 0.06
    is_red = (share[:, 0] > 0.65) & ~is_paint
    is_rim = (surface == atlas.rim) & (rgb.min(1) > 60)
    is_wheel = np.isin(surface, [atlas.rim, atlas.rubber])
    choices = [is_rim, is_wheel, is_paint, is_red, rgb.min(1) > 150, gloss > 0.9]
    known = ("rim", "dark", "paint", "red", "white", "glass")
    names = [MATERIALS.index(name) for name in known]
    return np.select(choices, names, MATERIALS.index("dark"))


def signed_distances(points: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Metres to the surface at the nodes of the half grid, negative inside, truncated."""
    low = -REACH * size_m / 2 - 2 * VOXEL_M
    count = np.ceil(-2 * low / VOXEL_M).astype(int)
    shell = np.zeros(count, bool)
    shell[tuple(np.floor((points - low) / VOXEL_M).astype(int).T)] = True
    solid = binary_closing(shell | _enclosed(shell), iterations=2)
    distance = distance_transform_edt(~solid) - distance_transform_edt(solid) + 0.5
    at = (nodes(size_m) - low) / VOXEL_M - 0.5
    found = map_coordinates(distance * VOXEL_M, at.T, order=1, mode="nearest")
    return np.clip(found, -TRUNCATION_M, TRUNCATION_M)


def _enclosed(shell: np.ndarray) -> np.ndarray:
    """Voxels (x, y, z) from which the shell is met to all six sides: it need not be closed."""
    ways = [np.flip(shell, axis) if back else shell for axis in range(3) for back in (False, True)]
    axes = [(axis, back) for axis in range(3) for back in (False, True)]
    met = [np.logical_or.accumulate(one, axis) for one, (axis, _) in zip(ways, axes, strict=True)]
    turned = [
        np.flip(one, axis) if back else one for one, (axis, back) in zip(met, axes, strict=True)
    ]
    return np.logical_and.reduce(turned)


def nodes(size_m: np.ndarray) -> np.ndarray:
    """Places (nodes, 3) of the half grid in a box, metres."""
    axes = [
        np.linspace(low, REACH, count) for low, count in zip((-REACH, 0, -REACH), GRID, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * size_m / 2


def shares(points: np.ndarray, material: np.ndarray, size_m: np.ndarray) -> np.ndarray:
    """Share of each material (nodes, materials) on the surface nearest to each node."""
    folded = points * [1, 0, 1] + np.abs(points) * [0, 1, 0]
    _, nearest = cKDTree(folded[::SHARE_THINNING]).query(nodes(size_m), NUM_NEIGHBOURS)
    return np.eye(len(MATERIALS))[material[::SHARE_THINNING][nearest]].mean(1)


def main() -> None:
    """Draw vehicles, and write the mean and the axes of their distances and materials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--without", choices=sorted(SHAPES))
    parser.add_argument("--out", type=Path, default=BUNDLED)
    asked = parser.parse_args()
    kinds = [shape for name, shape in SHAPES.items() if name != asked.without]
    fields, materials = drawn(kinds)
    table = torch.from_numpy(np.stack(fields))
    tensors, kept = model_of(table, torch.from_numpy(np.stack(materials)))
    header = {
        "made_by": "scripts/train_vehicle_shapes.py",
        "of": f"{len(kinds)} kinds of the synthetic street, {OF_EACH_KIND} of each, varied",
        "seed": SEED,
        "explained": round(kept, 4),
    }
    asked.out.parent.mkdir(exist_ok=True)
    write_tensors(asked.out, tensors, header)
    sys.stdout.write(f"{asked.out.stat().st_size} bytes, {kept:.1%} of the variance\n")


def drawn(kinds: list[CarShape]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Distances (nodes) and shares of materials (nodes, materials) of vehicles of some kinds."""
    rng = np.random.default_rng(SEED)
    fields, materials = [], []
    for shape in kinds:
        for number in range(OF_EACH_KIND):
            one, surfaces = varied(shape, rng), SurfaceSet()
            atlas = add_car_surfaces(surfaces, one, drawn_from(SEED + number, MARKED_PAINT))
            mesh, size_m = build_car(one, atlas)
            points, uv, surface = surface_samples(mesh, rng)
            fields.append(signed_distances(points, size_m))
            materials.append(shares(points, material_of(surfaces, atlas, uv, surface), size_m))
    return fields, materials


def model_of(table: torch.Tensor, materials: torch.Tensor) -> tuple[dict[str, torch.Tensor], float]:
    """What is stored of distances (vehicles, nodes) and shares, and how much that explains."""
    mean = table.mean(0)
    left, strength, axes = torch.linalg.svd(table - mean, full_matrices=False)
    deviation = strength[:NUM_AXES] / len(table) ** 0.5
    kept = float((strength[:NUM_AXES] ** 2).sum() / (strength**2).sum())
    # each axis as far as one standard deviation goes: latent numbers are then of deviation 1
    scaled = axes[:NUM_AXES] * deviation[:, None]
    latent = left[:, :NUM_SHARE_AXES] * len(table) ** 0.5
    known = torch.cat([torch.ones(len(latent), 1).double(), latent], dim=1)
    found = torch.linalg.lstsq(known, materials.flatten(1)).solution
    per_node = found.reshape(1 + NUM_SHARE_AXES, *GRID, len(MATERIALS)).movedim(-1, 1)
    tensors = {
        "mean_m": mean.reshape(GRID).half(),
        "axes_m": scaled.reshape(NUM_AXES, *GRID).half(),
        "shares_i8": (per_node / SHARE_STEP).round().clamp(-127, 127).to(torch.int8).contiguous(),
    }
    return tensors, kept


if __name__ == "__main__":
    main()
