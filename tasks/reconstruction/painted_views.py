"""Painted views as files: what the fit is guided by, and a few to look at.

Colours and weights are bytes and depth is half precision: a painting is not exact to more.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from catalog.artefacts import ArtefactRef
from catalog.store import Store
from lidarpainter_models.conditioning.novel_guidance import NovelPainting, guidance_views
from lidarpainter_models.export.images import write_png
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import GuidanceView
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors

GUIDANCE_FILE = "guidance.safetensors"
IMAGE_FOLDER = "images"
FULL_BYTE = 255
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


def save_guidance(folder: Path, paintings: Sequence[NovelPainting]) -> None:
    """Write the views that guide, and the middle view of every shift as images."""
    arrays: dict[str, Tensor] = {}
    records: list[dict[str, Any]] = []
    for index, view in enumerate(guidance_views(paintings)):
        arrays[f"{index}.rgb_u8"] = view.rgb_u8
        arrays[f"{index}.weight_u8"] = view.weight_u8
        arrays[f"{index}.lidar_depth_m"] = view.lidar_depth_f16
        arrays[f"{index}.world_from_camera"] = view.camera.world_from_camera
        lens = {name: getattr(view.camera, name) for name in LENS}
        records.append({"timestamp_ns": view.timestamp_ns, "lens": lens})
    write_tensors(folder / GUIDANCE_FILE, arrays, {"views": records})
    for painting in paintings:
        for name, rgb_u8 in painting.images.items():
            path = folder / IMAGE_FOLDER / painting.novel.shift.name / f"{name}.png"
            write_png(rgb_u8.float() / FULL_BYTE, path)


def load_guidance(store: Store, ref: ArtefactRef) -> tuple[GuidanceView, ...]:
    """Read the views that guide."""
    store.artefacts.verified(ref)
    arrays, metadata = read_tensors(store.artefacts.files(ref) / GUIDANCE_FILE)
    return tuple(
        GuidanceView(
            camera=Camera(world_from_camera=arrays[f"{index}.world_from_camera"], **row["lens"]),
            timestamp_ns=row["timestamp_ns"],
            rgb_u8=arrays[f"{index}.rgb_u8"],
            weight_u8=arrays[f"{index}.weight_u8"],
            lidar_depth_f16=arrays[f"{index}.lidar_depth_m"],
        )
        for index, row in enumerate(metadata["views"])
    )
