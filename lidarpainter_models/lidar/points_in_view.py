"""The points of a LiDAR map that fall into an image, and the grid on which they are compared.

The street stands in the world; an actor's points stand where its box is at the exposure. Depth is
camera z in metres. The grid is coarse: its cells follow an angle, not the pixels of the image.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import READ_ROUNDS, Camera
from lidarpainter_models.kernels.colour_sampling import project_inside, read_inside
from lidarpainter_models.lidar.actor_separation import poses_at
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.records import RecordedView, ViewKey
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

MOST_AGE_NS = 3_000_000_000
"""Images further in time from a point of the street than this are not asked for its colour: where a
nearer one shows it, it counts for less than half a percent beside that."""
NEAR_M = 0.5  # points nearer to the camera plane than this are left out
POINTS_AT_ONCE = 1 << 16
"""Points of the map that are looked at before those that matter of them are kept: all that an image
of a long log holds are many times as many."""

PlacedActors = Mapping[str, tuple[ActorTrack, Float[Tensor, "4 4"]]]
"""The tracks present at one time by actor id, with `world_from_box` then."""


@dataclass(frozen=True, eq=False)
class Body:
    """Points that move together: the street (no track), or an actor."""

    track: ActorTrack | None
    points: MapPoints
    most_age_ns: int | None = None
    """How far in time images may be from points that they are asked for; None is any time."""

    def stretches_about(self, timestamp_ns: int) -> list[slice]:
        """Stretches of the points that hold all that were measured about a time.

        Their length does not grow with that of the log where there is a most age.
        """
        if self.most_age_ns is None:
            return [slice(0, len(self.points))]
        first_row, first_ns, last_ns = self._runs
        is_near = last_ns >= timestamp_ns - self.most_age_ns
        is_near &= first_ns <= timestamp_ns + self.most_age_ns
        ends = np.diff(is_near, prepend=False, append=False).nonzero()[0].reshape(-1, 2)
        return [slice(*first_row[pair].tolist()) for pair in ends]

    @cached_property
    def _runs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where points of another sweep begin, all in all, and the time of each run's ends."""
        frame, time_ns = self.points.frame_index.numpy(), self.points.timestamp_ns.numpy()
        if not len(frame):
            return np.zeros(1, np.int64), time_ns, time_ns
        begins = np.concatenate([[0], np.diff(frame).nonzero()[0] + 1])
        first_ns, last_ns = (ends.reduceat(time_ns, begins) for ends in (np.minimum, np.maximum))
        return np.append(begins, len(frame)), first_ns, last_ns


@dataclass(frozen=True, eq=False)
class CellGrid:
    """A coarse grid over the image of a camera."""

    camera: Camera
    """Its pixels are the cells."""
    cells_per_pixel: Float[Tensor, "2"]
    """In u and v."""

    @classmethod
    def over(cls, camera: Camera, cell_rad: float) -> "CellGrid":
        """Cells of about an angle, never smaller than the camera's pixels."""
        cell_px = max(1.0, cell_rad * camera.fx_px)
        coarse = camera.resized(
            width_px=max(1, round(camera.width_px / cell_px)),
            height_px=max(1, round(camera.height_px / cell_px)),
        )
        shares = [coarse.width_px / camera.width_px, coarse.height_px / camera.height_px]
        return cls(coarse, torch.tensor(shares))

    def cells_of(self, pixels_uv: Float[Tensor, "points 2"]) -> Int[Tensor, "points 2"]:
        """Column and row of the cells that pixels of the camera lie in."""
        cells_uv = (pixels_uv * self.cells_per_pixel).long()
        cells_uv[:, 0].clamp_(max=self.camera.width_px - 1)
        cells_uv[:, 1].clamp_(max=self.camera.height_px - 1)
        return cells_uv


@dataclass(frozen=True, kw_only=True, eq=False)
class PointsInView:
    """Points of bodies that fall into an image."""

    rows: Int[Tensor, " points"]
    """Position among the points of all bodies."""
    pixels_uv: Float[Tensor, "points 2"]
    depth_m: Float[Tensor, " points"]
    range_m: Float[Tensor, " points"]
    """From the LiDAR that measured the point."""
    age_s: Float[Tensor, " points"]
    """Time between the image and the point, >= 0."""
    is_actor: Bool[Tensor, " points"]

    def __len__(self) -> int:
        return len(self.rows)

    def keep(self, kept: Tensor) -> "PointsInView":
        """The points listed."""
        return PointsInView(**{part.name: getattr(self, part.name)[kept] for part in fields(self)})

    @classmethod
    def none(cls) -> "PointsInView":
        """No points."""
        return cls(
            rows=torch.zeros(0, dtype=torch.int64),
            pixels_uv=torch.zeros(0, 2),
            depth_m=torch.zeros(0),
            range_m=torch.zeros(0),
            age_s=torch.zeros(0),
            is_actor=torch.zeros(0, dtype=torch.bool),
        )

    @classmethod
    def joined(cls, pieces: Sequence["PointsInView"]) -> "PointsInView":
        """All points of at least one piece, in their order."""
        return cls(
            **{
                part.name: torch.cat([getattr(piece, part.name) for piece in pieces])
                for part in fields(cls)
            }
        )


def place_actors(
    views: Sequence[RecordedView], tracks: Sequence[ActorTrack]
) -> dict[ViewKey, PlacedActors]:
    """The actors present at the exposure of each view."""
    if not views:
        return {}
    placed: dict[ViewKey, dict[str, tuple[ActorTrack, Tensor]]] = {view.key: {} for view in views}
    times_ns = torch.tensor([view.timestamp_ns for view in views])
    present = TrackPoses.of(tracks).present(times_ns[:, None])
    for number, track in enumerate(tracks):
        rows = present[:, number].nonzero()[:, 0]
        for row, world_from_box in zip(rows.tolist(), poses_at(track, times_ns[rows]), strict=True):
            placed[views[row].key][track.actor_id] = (track, world_from_box)
    return dict(placed)


def points_in_view(
    bodies: Sequence[Body], camera: Camera, timestamp_ns: int, actors: PlacedActors
) -> Iterator[PointsInView]:
    """Where the points of all bodies stand in an image taken at a time; absent actors have none.

    They come a piece after the other, in their order, so that nobody need hold them all. Those
    measured long before or after the image are left out. The street stands where a rolling shutter
    reads it, actors where they are in the middle.
    """
    first_rows = np.cumsum([0, *(len(body.points) for body in bodies)]).tolist()
    for first_row, body in zip(first_rows, bodies, strict=False):
        camera_from_points = camera.camera_from_world
        if body.track is not None:
            if body.track.actor_id not in actors:
                continue
            camera_from_points = camera_from_points @ actors[body.track.actor_id][1]
        for stretch in body.stretches_about(timestamp_ns):
            for start in range(stretch.start, stretch.stop, POINTS_AT_ONCE):
                piece = slice(start, min(start + POINTS_AT_ONCE, stretch.stop))
                inside, pixels_uv, depth_m = read_in_image(
                    body.points.xyz_m[piece],
                    camera_from_points,
                    camera,
                    stand_still=body.track is None,
                )
                rows = inside + piece.start
                age_ns = (body.points.timestamp_ns[rows] - timestamp_ns).abs()
                yield PointsInView(
                    rows=rows + first_row,
                    pixels_uv=pixels_uv,
                    depth_m=depth_m,
                    range_m=body.points.range_m[rows],
                    age_s=age_ns.float() * 1e-9,
                    is_actor=torch.full(rows.shape, body.track is not None),
                )


def read_in_image(
    xyz_m: Float[Tensor, "points 3"],
    camera_from_points: Float[Tensor, "4 4"],
    camera: Camera,
    *,
    stand_still: bool,
    margin_px: int = 0,
) -> tuple[Int[Tensor, " rows"], Float[Tensor, "rows 2"], Float[Tensor, " rows"]]:
    """What falls into an image with a margin: rows, pixels from the margin's corner, and depth.

    Points that stand still in the world are where a rolling shutter reads them, others where they
    are in the middle of it.
    """
    if stand_still and camera.shutter is not None and camera.shutter.is_rolling:
        return read_inside(xyz_m, camera.packed(), margin_px, NEAR_M, READ_ROUNDS)
    image = with_margin(camera, margin_px)
    lens = torch.tensor(
        [[image.fx_px, 0, image.cx_px], [0, image.fy_px, image.cy_px], [0, 0, 1]],
        dtype=torch.float64,
    )
    return project_inside(
        xyz_m, lens @ camera_from_points[:3], image.width_px, image.height_px, NEAR_M
    )


def with_margin(camera: Camera, margin_px: int) -> Camera:
    """The same view with so many pixels more on each side."""
    return replace(
        camera,
        cx_px=camera.cx_px + margin_px,
        cy_px=camera.cy_px + margin_px,
        width_px=camera.width_px + 2 * margin_px,
        height_px=camera.height_px + 2 * margin_px,
    )
