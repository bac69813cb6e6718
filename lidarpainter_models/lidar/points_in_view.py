"""The points of a LiDAR map that fall into an image, and the grid on which they are compared.

The street stands in the world; an actor's points stand where its box is at the exposure. Depth is
camera z in metres. The grid is coarse: its cells follow an angle, not the pixels of the image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.colour_sampling import project_inside
from lidarpainter_models.lidar.actor_separation import poses_at
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.scenes.records import RecordedView, ViewKey
from lidarpainter_models.scenes.tracks import ActorTrack, TrackPoses

PlacedActors = Mapping[str, tuple[ActorTrack, Float[Tensor, "4 4"]]]
"""The tracks present at one time by actor id, with `world_from_box` then."""


@dataclass(frozen=True, eq=False)
class Body:
    """Points that move together: the street (no track), or an actor."""

    track: ActorTrack | None
    points: MapPoints


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
    """Points of all bodies that fall into an image."""

    rows: Int[Tensor, " points"]
    """Position among the points of all bodies."""
    pixels_uv: Float[Tensor, "points 2"]
    cells_uv: Int[Tensor, "points 2"]
    """Column and row on the grid."""
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
    bodies: Sequence[Body],
    camera: Camera,
    timestamp_ns: int,
    actors: PlacedActors,
    grid: CellGrid,
    *,
    near_m: float,
) -> PointsInView:
    """Where the points of all bodies stand in an image taken at a time; absent actors have none.

    The street stands where a rolling shutter reads it, actors where they are in the middle.
    """
    lens = torch.tensor(
        [[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]],
        dtype=torch.float64,
    )
    parts: list[dict[str, Tensor]] = []
    first_row = 0
    for body in bodies:
        start, first_row = first_row, first_row + len(body.points)
        camera_from_points = camera.camera_from_world
        if body.track is not None:
            if body.track.actor_id not in actors:
                continue
            _, world_from_box = actors[body.track.actor_id]
            camera_from_points = camera_from_points @ world_from_box
        inside, pixels_uv, depth_m = project_inside(
            body.points.xyz_m,
            lens @ camera_from_points[:3],
            camera.width_px,
            camera.height_px,
            near_m,
        )
        if body.track is None and camera.shutter is not None and camera.shutter.is_rolling:
            read_uv, _ = camera.project(body.points.xyz_m[inside].double())
            size = torch.tensor([camera.width_px, camera.height_px]) - 1e-3
            pixels_uv = read_uv.clamp(torch.zeros(2), size).to(pixels_uv)
        age_ns = (body.points.timestamp_ns[inside] - timestamp_ns).abs()
        parts.append(
            {
                "rows": inside + start,
                "pixels_uv": pixels_uv,
                "depth_m": depth_m,
                "range_m": body.points.range_m[inside],
                "age_s": age_ns.float() * 1e-9,
                "is_actor": torch.full(inside.shape, body.track is not None),
            }
        )
    columns = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return PointsInView(**columns, cells_uv=grid.cells_of(columns["pixels_uv"]))
