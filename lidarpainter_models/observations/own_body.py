"""Which pixels of a camera show the recording car itself: what never moves while the car does.

Between two images of a moving car every edge of the street slides along its epipolar line, farther
the nearer it is; an edge of the car's own bonnet, boot or mirror stays. So brightness is derived
along the epipolar lines, and the median over images taken far apart (as in Dekel et al. 2017, who
find watermarks so) keeps only what stays. It is asked only where the street would have moved: below
the horizon, where even the ground is near. What the edges that stay enclose with the border of the
image is the body. At night a bonnet may be lit by each lamp that it passes: then its outline stays
while its brightness does not, and what stays is the place of the change alone. A car that stands
shows no body, and nor does one as dark as the road.
"""

import math
from collections.abc import Sequence
from operator import attrgetter

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import median_filter
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView

WIDTH_PX = 480
"""Width at which images are compared."""
MOST_IMAGES, LEAST_IMAGES = 24, 3
"""Images of a camera that are compared, evenly over the way; fewer tell nothing."""
LEAST_BASELINE_M = 0.2
"""Images taken nearer to each other than this count as one."""
LEAST_MOTION_PX = 10.0
"""A place is judged where the ground would have moved so far from the first image to the last."""
LOWER_PART, LEAST_LOOKED_AT = 4, 0.7
"""Bodies are at the bottom: images of whose lowest fourth less is judged were not searched."""
LEAST_PX_PER_DEG = 2.2
"""In coarser images, behind wide lenses, edges of bodies blur and are lost; what is found stays."""
MOST_HEIGHT_M = 3.0
"""No camera stands higher above the road; a lower one sees nearer ground, which moves faster."""
LEAST_HIDDEN = 0.05  # of where a body would show: so much behind other cars is worth saying
LEAST_EDGE = 1.5  # grey levels a pixel that stay
LEAST_ACROSS = 0.3
"""Of the whole change of brightness, so much is along the epipolar line: lane markings and curbs
slide along themselves."""
RIDGE = 2.5
"""A change that stays in place is so much larger than that around it, whatever its sign."""
RIDGE_PX = 25  # what is around
LINE_SHARE, FEW_LINE_SHARE, FEW_IMAGES = 0.04, 0.15, 8
"""Of the width: shorter pieces of an edge tell nothing; the second where images are few, for then
patterns of the street meet by chance. Of few images only a body as wide as a bonnet is believed."""
WIDE_SHARE = 0.5  # of the width: so long an edge need not reach the border, which may be dark
GAP_SHARE = 0.25  # of the width: an edge across the image may be hidden so far
STAYS_IN = 0.85
"""A sure edge is there in so many of the images."""
STANDS_OUT = 2.4
"""One that goes on beside sure ones is there so much more often than in half of them, in standard
deviations (sign test)."""
SURE_SHARE = 0.25  # of the edges of a body
GROUP_SHARE = 0.03  # of the width: edges nearer to each other than twice this are of one body
BORDER_SHARE = 0.03  # of the width: a body comes so near to the border of the image
LEAST_AREA = 0.005  # of the image
LEAST_OUTLINE = 0.6  # of a body's outline inside the image: so much of it is an edge that stays
OUTLINE_PX = 7  # an outline runs along edges at most half of this away
BLUR_PX = 1.0


def own_bodies(
    scene: DrivingScene, views: Sequence[RecordedView]
) -> dict[str, Bool[np.ndarray, "height width"]]:
    """Pixels of the recording car, `WIDTH_PX` wide, by the cameras that show any of it.

    Nothing for cameras that `cannot_be_told` names.
    """
    moving = MovingBoxes([track for track in scene.tracks if track.is_moving])
    chosen = _far_apart_of_cameras(views)
    bodies = side_by_side(lambda own: _own_body(scene, own, moving), list(chosen.values()))
    return {name: body for name, body in zip(chosen, bodies, strict=True) if body.any()}


def cannot_be_told(views: Sequence[RecordedView]) -> dict[str, str]:
    """Why the search could not look, by the cameras of which it cannot tell."""
    whys = {name: _too_little(apart) for name, apart in _far_apart_of_cameras(views).items()}
    return {name: why for name, why in whys.items() if why is not None}


def behind_traffic(scene: DrivingScene, views: Sequence[RecordedView]) -> dict[str, float]:
    """The share of where a body would show that other cars hide in most images, by camera.

    Nothing can be told there. Cameras of which less than `LEAST_HIDDEN` is hidden are left out.
    """
    moving = MovingBoxes([track for track in scene.tracks if track.is_moving])
    shares = {}
    for name, own in _far_apart_of_cameras(views).items():
        cameras = _compared(own)
        pixels = [
            moving.pixels(camera, view.timestamp_ns).numpy()
            for camera, view in zip(cameras, own, strict=True)
        ]
        is_hidden = np.mean(pixels, axis=0) > 0.5
        if (looked_at := _would_have_moved(cameras)).any():
            shares[name] = float(is_hidden[looked_at].mean())
    return {name: share for name, share in shares.items() if share >= LEAST_HIDDEN}


def _too_little(apart: Sequence[RecordedView]) -> str | None:
    """What keeps the search from looking at a camera's views that are far apart."""
    if len(apart) < LEAST_IMAGES:
        return f"{len(apart)} images taken apart, {LEAST_IMAGES} needed"
    cameras = _compared(apart)
    moved = _would_have_moved(cameras)
    if moved[-moved.shape[0] // LOWER_PART :].mean() < LEAST_LOOKED_AT:
        width_px = moved.shape[1]
        return f"in images {width_px} px wide the street near the car moved too little to tell"
    px_per_deg = cameras[0].fx_px * math.radians(1)
    if px_per_deg < LEAST_PX_PER_DEG:
        return f"compared at {px_per_deg:.1f} pixels a degree, {LEAST_PX_PER_DEG} are needed"
    return None


def _compared(views: Sequence[RecordedView]) -> list[Camera]:
    """The cameras of some views on the grid on which their images are compared."""
    # images of one camera may differ in size: binning that was switched on, an exchanged mode
    small = min((view.camera.no_wider(WIDTH_PX) for view in views), key=attrgetter("width_px"))
    size = {"width_px": small.width_px, "height_px": small.height_px}
    return [view.camera.resized(**size) for view in views]


def _own_body(
    scene: DrivingScene, views: Sequence[RecordedView], moving: MovingBoxes
) -> Bool[np.ndarray, "height width"]:
    """What stays in views of one camera that are far apart."""
    cameras = _compared(views)
    if len(views) < LEAST_IMAGES:
        return np.zeros((cameras[0].height_px, cameras[0].width_px), np.bool_)
    seen = [
        _seen_change(scene.read_image(view), camera, _way(cameras, place), moving, view)
        for place, (view, camera) in enumerate(zip(views, cameras, strict=True))
    ]
    edges, sure = (mask & _would_have_moved(cameras) for mask in _what_stays(seen))
    return _enclosed(edges, sure, only_wide=len(seen) < FEW_IMAGES)


def in_words(camera_name: str, body: Bool[np.ndarray | Tensor, "height width"]) -> str:
    """What a camera shows of the car, as a sentence."""
    share = float(np.asarray(body).mean())
    return f"{camera_name} shows the recording car in {share:.0%} of its image: hidden."


def on_grid(
    body: Bool[np.ndarray, "height width"], *, width_px: int, height_px: int
) -> Bool[Tensor, "rows columns"]:
    """The body on the grid of an image of another size."""
    resized = cv2.resize(
        body.astype(np.uint8), (width_px, height_px), interpolation=cv2.INTER_NEAREST
    )
    return torch.from_numpy(resized > 0)


def _far_apart_of_cameras(views: Sequence[RecordedView]) -> dict[str, list[RecordedView]]:
    """Some of each camera's views, evenly over the way."""
    names = sorted({view.camera_name for view in views})
    return {name: _far_apart([v for v in views if v.camera_name == name]) for name in names}


def _far_apart(views: Sequence[RecordedView]) -> list[RecordedView]:
    kept: list[RecordedView] = []
    for view in sorted(views, key=lambda view: view.timestamp_ns):
        if not kept or baseline_m(kept[-1], view) >= LEAST_BASELINE_M:
            kept.append(view)
    return kept[:: max(1, -(-len(kept) // MOST_IMAGES))]


def baseline_m(first: RecordedView, second: RecordedView) -> float:
    """How far the cameras of two views stand from each other."""
    return float((first.camera.centre_world - second.camera.centre_world).norm())


def _way(cameras: Sequence[Camera], place: int) -> Float[np.ndarray, "3"]:
    """Where a camera was going, in its own frame, by those before and after it."""
    before, after = cameras[max(place - 1, 0)], cameras[min(place + 1, len(cameras) - 1)]
    way = after.centre_world - before.centre_world
    return (cameras[place].world_from_camera[:3, :3].T.to(way) @ way).double().numpy()


def _flow(camera: Camera, way: Float[np.ndarray, "3"]) -> Float[np.ndarray, "height width 2"]:
    """By how many pixels each point a metre deep moves in the image of a camera that goes so."""
    rays = camera.pixel_directions().double().numpy()
    rays /= rays[..., 2:]
    focal = np.array([camera.fx_px, camera.fy_px])
    return focal * (rays[..., :2] * way[2] - way[:2])


def _seen_change(
    image: UInt8[Tensor, "recorded_height recorded_width 3"],
    camera: Camera,
    way: Float[np.ndarray, "3"],
    moving: MovingBoxes,
    view: RecordedView,
) -> tuple[Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
    """Change of brightness along the epipolar lines, and where no other car may drive along."""
    size = (camera.width_px, camera.height_px)
    small = cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    down, right = np.gradient(cv2.GaussianBlur(grey, (0, 0), BLUR_PX))
    flow = _flow(camera, way)
    length = np.maximum(np.linalg.norm(flow, axis=-1), 1e-9)
    change = (right * flow[..., 0] + down * flow[..., 1]) / length
    change[np.abs(change) < LEAST_ACROSS * np.hypot(right, down)] = 0
    return change.astype(np.float32), ~moving.pixels(camera, view.timestamp_ns).numpy()


def _what_stays(
    seen: Sequence[tuple[Float[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]],
) -> tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
    """Pixels on the same edge in most of the images that count, and in nearly all of them."""
    total = np.maximum(sum(counts.astype(int) for _, counts in seen), 1)
    sign = np.sign(sum(change * counts for change, counts in seen))
    held = sum((sign * change > LEAST_EDGE) & counts for change, counts in seen)
    strength = sum(np.abs(change) * counts for change, counts in seen) / total
    around = cv2.blur(strength.astype(np.float32), (RIDGE_PX, RIDGE_PX))
    either = sum((np.abs(change) > LEAST_EDGE) & counts for change, counts in seen)
    held = np.where(strength > RIDGE * around, either, held)
    stands_out = 2 * held - total > STANDS_OUT * np.sqrt(total)
    stands_out |= (held == total) & (total >= LEAST_IMAGES)  # as sure as a few images can be
    lines = _long(stands_out, FEW_LINE_SHARE if len(seen) < FEW_IMAGES else LINE_SHARE)
    return lines, lines & (held > STAYS_IN * total)


def _long(
    edges: Bool[np.ndarray, "height width"], least_share: float
) -> Bool[np.ndarray, "height width"]:
    """The edges that go on for this share of the width."""
    window = np.ones((3, 3), np.uint8)
    count, pieces, extents, _ = cv2.connectedComponentsWithStats(
        cv2.dilate(edges.astype(np.uint8), window)
    )
    sides_px = extents[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    is_long = (sides_px >= least_share * edges.shape[1]) & (np.arange(count) > 0)
    return edges & is_long[pieces]


def _would_have_moved(cameras: Sequence[Camera]) -> Bool[np.ndarray, "height width"]:
    """Pixels in which whatever stands on the ground has moved far by the last image."""
    middle = cameras[len(cameras) // 2]
    rotation = middle.world_from_camera[:3, :3].double()
    way = rotation.T @ (cameras[-1].centre_world - cameras[0].centre_world).double()
    rays = middle.pixel_directions().double()
    falls = -((rays / rays[..., 2:]) @ rotation[2]).numpy()  # metres a metre of depth
    motion_px = np.linalg.norm(_flow(middle, way.numpy()), axis=-1)
    return motion_px * np.maximum(falls, 0) / MOST_HEIGHT_M > LEAST_MOTION_PX


def _enclosed(
    edges: Bool[np.ndarray, "height width"],
    sure: Bool[np.ndarray, "height width"],
    *,
    only_wide: bool,
) -> Bool[np.ndarray, "height width"]:
    """What groups of edges near the border of the image enclose with that border."""
    height, width = edges.shape
    body = np.zeros((height, width), np.uint8)
    outlines: list[np.ndarray | None] = []
    found: list[Int[np.ndarray, "points 2"]] = []
    reach = round(GROUP_SHARE * width)
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    count, groups = cv2.connectedComponents(cv2.dilate(edges.astype(np.uint8), window))
    for group in range(1, count):
        row, column = np.nonzero(edges & (groups == group))
        if sure[row, column].mean() < SURE_SHARE:
            continue
        points = np.stack([column, row], axis=1).astype(np.int32)
        outline = None if only_wide else _outline_at_border(points, edges)
        outlines.append(_outline_across(points, edges.shape) if outline is None else outline)
        found.append(points)
    if found and not (only_wide or any(_is_wide(points, width) for points in found)):
        outlines.append(_outline_across(np.concatenate(found), edges.shape))
    for outline in outlines:
        if outline is not None and cv2.contourArea(outline) >= LEAST_AREA * edges.size:
            cv2.fillPoly(body, [outline], 1)
    return body > 0


def _outline_at_border(
    points: Int[np.ndarray, "points 2"], edges: Bool[np.ndarray, "height width"]
) -> np.ndarray | None:
    """What edges near a border of the image enclose with it; None where it is no body."""
    height, width = edges.shape
    to_border = np.stack([points[:, 0], width - 1 - points[:, 0], height - 1 - points[:, 1]])
    if to_border.min() > BORDER_SHARE * width:
        return None
    sides = ((1, height - 1), (0, 0), (0, width - 1))
    hulls = [_hull_to_border(points, axis, at) for axis, at in sides]
    sound = [hull for hull in hulls if _outlined(hull, edges) >= LEAST_OUTLINE]
    return max(sound, key=cv2.contourArea, default=None)


def _outline_across(
    points: Int[np.ndarray, "points 2"], shape: tuple[int, int]
) -> np.ndarray | None:
    """What lies below one edge across most of the image; None where there is no such edge."""
    height, width = shape
    columns = np.unique(points[:, 0])
    if not _is_wide(points, width) or np.diff(columns).max() > GAP_SHARE * width:
        return None
    row = np.array([points[points[:, 0] == column, 1].min() for column in columns], np.float64)
    upper = np.interp(np.arange(width), columns, median_filter(row, round(GROUP_SHARE * width)))
    if np.abs(points[:, 1] - upper[points[:, 0]]).mean() > GROUP_SHARE * width:
        return None
    line = np.stack([np.arange(width), upper.round()], axis=1)
    ends = [(width - 1, height - 1), (0, height - 1)]
    return np.concatenate([line, ends]).astype(np.int32)


def _is_wide(points: Int[np.ndarray, "points 2"], width: int) -> bool:
    return len(np.unique(points[:, 0])) >= WIDE_SHARE * width


def _hull_to_border(points: Int[np.ndarray, "points 2"], axis: int, at: int) -> np.ndarray:
    """The hull of points and of their feet on one side of the image."""
    feet = points.copy()
    feet[:, axis] = at
    return cv2.convexHull(np.concatenate([points, feet]))


def _outlined(hull: np.ndarray, edges: Bool[np.ndarray, "height width"]) -> float:
    """Part of a hull's outline inside the image that runs along edges."""
    outline = np.zeros(edges.shape, np.uint8)
    cv2.polylines(outline, [hull], isClosed=True, color=1)
    outline[-1], outline[:, 0], outline[:, -1] = 0, 0, 0
    near = cv2.dilate(edges.astype(np.uint8), np.ones((OUTLINE_PX, OUTLINE_PX), np.uint8))
    return float(near[outline > 0].mean()) if outline.any() else 0.0
