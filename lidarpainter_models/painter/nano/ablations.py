"""Variants of the small painter that are trained alike to see what each part of it is worth.

The first table follows the paper's ablation of input guidance row by row, worst first; its
reference is the nearest recorded image, not carried into the view. The other tables change one
thing about the whole painter.
"""

from dataclasses import replace
from typing import Any

from lidarpainter_models.painter.nano.network import NanoConfig

REFERENCE = "reference"
INPUT_ROWS = (
    ("lidar", REFERENCE),
    ("lidar",),
    ("render", REFERENCE),
    ("render",),
    ("render", "lidar"),
    ("render", "lidar", REFERENCE),
    ("render", "warp"),
    ("render", "lidar", "warp"),
)
"""What painters may see: the paper's five rows, then the reference beside both, and the warps."""
CHANGES: dict[str, tuple[str, dict[str, Any]]] = {
    "fusion": ("direct", {"mix": False}),
    "lidar": ("composite", {"composite": True}),
    "skips": ("no skips", {"skips": False}),
}
"""By table: what the changed painter is called, and its settings."""


def ablation_tables(network: NanoConfig) -> dict[str, dict[str, NanoConfig]]:
    """The variants of each table by their label; variants of one label are the same."""
    inputs = {"+".join(row): replace(network, inputs=frozenset(row)) for row in INPUT_ROWS}
    full, whole = list(inputs.items())[-1]
    changed = {
        name: {full: whole, f"{full}, {label}": replace(whole, **change)}
        for name, (label, change) in CHANGES.items()
    }
    return {"inputs": inputs} | changed
