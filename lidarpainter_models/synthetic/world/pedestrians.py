"""People made of tubes and balls, in mid-stride, in their box frames."""

import numpy as np

from lidarpainter_models.synthetic.textures.surfaces import (
    StreetClass,
    Surface,
    SurfaceSet,
    tint_from_bytes,
)
from lidarpainter_models.synthetic.world.meshes import Mesh, MeshBuilder
from lidarpainter_models.synthetic.world.solids import add_ball, add_tube

CLOTHES = (
    (40, 48, 78), (160, 40, 44), (70, 84, 60), (202, 192, 170), (30, 30, 32), (188, 138, 60),
    (96, 110, 140), (120, 60, 96),
)  # fmt: skip
SKIN = ((224, 178, 146), (150, 104, 76), (196, 146, 112), (96, 66, 50))


def build_pedestrian(surfaces: SurfaceSet, rng: np.random.Generator) -> tuple[Mesh, np.ndarray]:
    """A walking person of 1.6 to 1.9 m (origin at the box's centre) and the box's size."""

    def cloth(colours: tuple[tuple[int, int, int], ...]) -> int:
        tint = tint_from_bytes(colours[int(rng.integers(len(colours)))])
        return surfaces.add(Surface(semantics=StreetClass.PEDESTRIAN, tint=tint))

    builder = MeshBuilder()
    coat, trousers, skin, shoe = cloth(CLOTHES), cloth(CLOTHES), cloth(SKIN), cloth(CLOTHES[4:5])
    stride, swing = rng.uniform(0.1, 0.26), rng.uniform(0.1, 0.25)
    for side in (-1.0, 1.0):
        hip, knee = (0.0, side * 0.09, 0.92), (side * stride * 0.6, side * 0.1, 0.5)
        foot = (side * stride, side * 0.1, 0.08)
        add_tube(builder, knee, hip, (0.07, 0.095), trousers)
        add_tube(builder, foot, knee, (0.05, 0.07), trousers)
        add_ball(builder, (foot[0] + 0.05, foot[1], 0.05), (0.14, 0.05, 0.05), shoe)
        shoulder, elbow = (0.0, side * 0.2, 1.42), (-side * swing * 0.4, side * 0.26, 1.14)
        hand = (-side * swing + 0.1, side * 0.25, 0.9)
        add_tube(builder, elbow, shoulder, (0.05, 0.065), coat)
        add_tube(builder, hand, elbow, (0.04, 0.05), coat)
        add_ball(builder, hand, (0.05, 0.05, 0.06), skin)
    add_tube(builder, (0, 0, 0.88), (0, 0, 1.45), (0.17, 0.2), coat, has_caps=True)
    add_ball(builder, (0, 0, 1.45), (0.15, 0.23, 0.1), coat)
    add_tube(builder, (0, 0, 1.45), (0.01, 0, 1.56), (0.06, 0.06), skin)
    add_ball(builder, (0.02, 0, 1.64), (0.1, 0.085, 0.125), skin)
    add_ball(builder, (0.0, 0, 1.68), (0.105, 0.095, 0.11), cloth(CLOTHES))
    scale = rng.uniform(0.92, 1.06)
    mesh = builder.build().transformed(np.diag([scale, scale, scale, 1.0]))
    corners = mesh.corners().reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    shift = np.eye(4)
    shift[:3, 3] = -(low + high) / 2
    return mesh.transformed(shift), high - low
