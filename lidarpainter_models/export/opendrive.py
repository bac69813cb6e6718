"""The driven road as OpenDRIVE 1.7 (ASAM, 2021), the map that simulators read.

World frame, z up, metres: x and y of the file are those of the world. One road without junctions:
its reference line is where traffic against us begins (left of all lanes that go our way), in cubic
pieces of Hermite; its heights are those of the ground. What no marking told is named in `userData`.
"""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from lidarpainter_models.lidar.ground_surface import GroundSurface
from lidarpainter_models.lidar.road_lanes import Lane, Road

PIECE_M = 5.0
"""A cubic piece so long is nearer than a millimetre to any line that a car can drive."""
SMOOTH_PIECES = 1.0
"""Deviation of the Gaussian over heights, in pieces: a road has no steps."""
_MARK_WIDTH_M = 0.15


def opendrive(road: Road, ground: GroundSurface, name: str, said: Mapping[str, str]) -> bytes:
    """The road as the bytes of an .xodr file.

    Args:
        road: the driven road with its lanes.
        ground: its heights.
        name: of the road.
        said: what else is to be known, as `userData` of the file by code.
    """
    root = ET.Element("OpenDRIVE")
    low, high = road.line.xy_m.min(axis=0) - 20, road.line.xy_m.max(axis=0) + 20
    header = _add(
        root,
        "header",
        revMajor=1,
        revMinor=7,
        name=name,
        version="1.00",
        west=low[0],
        east=high[0],
        south=low[1],
        north=high[1],
        vendor="LidarPainter",
    )
    for code, value in said.items():
        _add(header, "userData", code=code, value=value)
    pieces = max(1, round((road.line.s_m[-1] - road.line.s_m[0]) / PIECE_M))
    along_m = np.linspace(road.line.s_m[0], road.line.s_m[-1], pieces + 1)
    split = next((n for n, one in enumerate(road.lanes) if not one.is_forward), len(road.lanes))
    reference_d_m = road.lanes[split - 1].left_d_m if split else road.lanes[0].right_d_m
    geometry, starts_m = _geometry(road, along_m, reference_d_m)
    element = _add(root, "road", name=name, length=starts_m[-1], id=1, junction=-1, rule="RHT")
    _add(_add(element, "type", s=0, type="town"), "speed", max="undefined")
    element.append(geometry)
    known_m = ground.everywhere().at(road.line.place(along_m, reference_d_m))
    heights_m = gaussian_filter1d(known_m, SMOOTH_PIECES, mode="nearest")
    _add_heights(_add(element, "elevationProfile"), starts_m, heights_m)
    section = _add(_add(element, "lanes"), "laneSection", s=0)
    left = [(n + 1, lane) for n, lane in enumerate(road.lanes[split:])]
    _add_lanes(section, "left", left[::-1], "left_mark")
    centre = _add(_add(section, "center"), "lane", id=0, type="none", level="false")
    inner = road.lanes[split - 1].left_mark if split else road.lanes[0].right_mark
    _add_mark(centre, inner)
    right = [(-n - 1, lane) for n, lane in enumerate(road.lanes[:split][::-1])]
    _add_lanes(section, "right", right, "right_mark")
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _geometry(
    road: Road, along_m: Float[np.ndarray, " ends"], d_m: float
) -> tuple[ET.Element, Float[np.ndarray, " ends"]]:
    """The reference line as cubic pieces; how far along it each begins and the last ends."""
    ends = road.line.place(along_m, d_m)
    step_m = 0.1
    tangent = road.line.place(along_m + step_m, d_m) - road.line.place(along_m - step_m, d_m)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    plan, starts_m = ET.Element("planView"), [0.0]
    share = np.linspace(0, 1, 65)[:, None]
    for (first, second), (begin_rad, end_rad) in zip(
        pairwise(ends), pairwise(heading), strict=True
    ):
        cosine, sine = np.cos(begin_rad), np.sin(begin_rad)
        way = np.array([[cosine, sine], [-sine, cosine]]) @ (second - first)
        chord_m, turn_rad = float(np.linalg.norm(way)), end_rad - begin_rad
        last = chord_m * np.array([np.cos(turn_rad), np.sin(turn_rad)])
        linear = np.array([chord_m, 0.0])
        square, cube = 3 * way - 2 * linear - last, linear + last - 2 * way
        points = share * linear + share**2 * square + share**3 * cube
        length_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        piece = _add(
            plan, "geometry", s=starts_m[-1], x=first[0], y=first[1], hdg=begin_rad, length=length_m
        )
        terms = zip("UV", linear, square, cube, strict=True)
        curve = {
            f"{order}{axis}": value
            for axis, *values in terms
            for order, value in zip("abcd", (0.0, *values), strict=True)
        }
        _add(piece, "paramPoly3", **curve, pRange="normalized")
        starts_m.append(starts_m[-1] + length_m)
    return plan, np.array(starts_m)


def _add_lanes(
    section: ET.Element, side: str, lanes: list[tuple[int, Lane]], outer_mark: str
) -> None:
    """The lanes of one side of the reference line, by their number."""
    if not lanes:
        return
    parent = _add(section, side)
    for number, lane in lanes:
        kind = "driving" if lane.is_driving else "shoulder"
        element = _add(parent, "lane", id=number, type=kind, level="false")
        _add(element, "width", sOffset=0, a=lane.left_d_m - lane.right_d_m, b=0, c=0, d=0)
        _add_mark(element, getattr(lane, outer_mark))
        if lane.assumed:
            _add(element, "userData", code="assumed", value=lane.assumed)


def _add_mark(lane: ET.Element, mark: str) -> None:
    _add(
        lane,
        "roadMark",
        sOffset=0,
        type=mark,
        weight="standard",
        color="standard",
        width=_MARK_WIDTH_M,
    )


def _add_heights(
    parent: ET.Element,
    starts_m: Float[np.ndarray, " ends"],
    heights_m: Float[np.ndarray, " ends"],
) -> None:
    """A profile through heights at the ends of the pieces, with continuous slope."""
    slope = np.gradient(heights_m, starts_m)
    for number, length_m in enumerate(np.diff(starts_m)):
        a, b, last = heights_m[number], slope[number], slope[number + 1]
        rise = (heights_m[number + 1] - a) / length_m
        c, d = (3 * rise - 2 * b - last) / length_m, (b + last - 2 * rise) / length_m**2
        _add(parent, "elevation", s=starts_m[number], a=a, b=b, c=c, d=d)


def _add(parent: ET.Element, tag: str, **values: float | str) -> ET.Element:
    """A child with numbers as text."""
    words = {
        name: value if isinstance(value, str) else f"{value:.12g}" for name, value in values.items()
    }
    return ET.SubElement(parent, tag, words)
