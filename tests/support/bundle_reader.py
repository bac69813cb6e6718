"""A reader of simulators' bundles, written from the description of the form and nothing else.

It opens a .usdz as a zip, and its texts with the parsers of the standard library and PyYAML.
"""

import json
import struct
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import dataclass

import numpy as np
import yaml


@dataclass(frozen=True)
class ReadBundle:
    """What a simulator takes from a bundle."""

    starts: list
    """Where the bytes of each member begin."""
    metadata: dict
    rig: dict
    tracks: dict
    meshes: dict
    road: ET.Element


def read_bundle(path):
    """Everything of a bundle."""
    with zipfile.ZipFile(path) as packed:
        members = packed.infolist()
        texts = {one.filename: packed.read(one) for one in members}
    content = path.read_bytes()
    starts = []
    for one in members:
        name_bytes, extra_bytes = struct.unpack_from("<HH", content, one.header_offset + 26)
        starts.append(one.header_offset + 30 + name_bytes + extra_bytes)
    (tracks,) = json.loads(texts["sequence_tracks.json"]).values()
    return ReadBundle(
        starts=starts,
        metadata=yaml.safe_load(texts["metadata.yaml"]),
        rig=json.loads(texts["rig_trajectories.json"]),
        tracks=tracks,
        meshes={name: read_mesh(texts[name]) for name in ("mesh.ply", "mesh_ground.ply")},
        road=ET.fromstring(texts["map.xodr"]),  # noqa: S314 - of a test
    )


def read_mesh(content):
    """Vertices and faces of a PLY file, through plyfile."""
    import io

    from plyfile import PlyData

    ply = PlyData.read(io.BytesIO(content))
    vertices = np.stack([ply["vertex"][axis] for axis in "xyz"], axis=1)
    return vertices, np.stack(list(ply["face"]["vertex_indices"]))


def reference_line(road, step_m=0.25):
    """World x, y, z and heading along the reference line of an OpenDRIVE road."""
    found = []
    for piece in road.find("road/planView"):
        start = {name: float(piece.get(name)) for name in ("s", "x", "y", "hdg", "length")}
        terms = piece.find("paramPoly3")
        assert terms.get("pRange") == "normalized"
        p = np.linspace(0, 1, max(2, int(start["length"] / step_m)))
        u, v = (
            sum(float(terms.get(f"{one}{axis}")) * p**n for n, one in enumerate("abcd"))
            for axis in "UV"
        )
        cosine, sine = np.cos(start["hdg"]), np.sin(start["hdg"])
        x, y = start["x"] + cosine * u - sine * v, start["y"] + sine * u + cosine * v
        s = start["s"] + p * start["length"]
        found.append(np.stack([s, x, y, heights_m(road, s)], axis=1))
    return np.concatenate(found)


def heights_m(road, s_m):
    """The height of the reference line along the road."""
    found = [
        [float(one.get(key)) for key in "sabcd"]
        for one in road.findall("road/elevationProfile/elevation")
    ]
    rows = np.array(found)
    row = rows[np.clip(np.searchsorted(rows[:, 0], s_m, side="right") - 1, 0, len(rows) - 1)]
    ds = s_m - row[:, 0]
    return row[:, 1] + ds * (row[:, 2] + ds * (row[:, 3] + ds * row[:, 4]))
