"""A drive recorded into one page that plays it from the disk, without a server."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from lidarpainter_models.export.images import jpeg_data_url
from lidarpainter_models.export.page import FirstView, PageNotes, sealed_page
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.trajectory_specs import Trajectory
from lidarpainter_models.viewing.annotations import vertical_fov_rad
from lidarpainter_models.viewing.drive_nodes import DriveNodes, ShownDrive
from lidarpainter_models.viewing.servers import local_server

TITLE_M = 10.0
"""How far ahead of the seat the title of a leg stands, near the upper edge of the view."""
LAST_S = 0.1
"""How long the last moment stands."""
FIRST_VIEW_PX = (1296, 540)
"""Width and height of the picture of the first view: wider than windows are."""


@dataclass(frozen=True, kw_only=True)
class Leg:
    """One way along the drive."""

    title: str
    """What is written over it."""
    trajectory: Trajectory


def recorded_page(
    drive: ShownDrive,
    legs: Sequence[Leg],
    notes: PageNotes,
    *,
    progress: Callable[[int, int], None],
) -> str:
    """A page that drives all legs one after another; tells how many moments are done."""
    views = drive.path.views
    times_s = [view.timestamp_ns * 1e-9 for view in views]
    pauses_s = [after - before for before, after in pairwise(times_s)]
    pauses_s.append(pauses_s[-1] if pauses_s else LAST_S)
    with local_server(port=0) as server:
        nodes = DriveNodes(server, drive)
        seat = drive.path.camera(0)
        edge_m = TITLE_M * math.tan(vertical_fov_rad(seat) / 2)
        label = server.scene.add_label(
            "/title",
            legs[-1].title,  # else the first leg would say nothing when the page begins again
            position=(TITLE_M, 0.0, 0.85 * edge_m),
            font_screen_scale=1.5,
            anchor="center-center",
        )
        nodes.place(views[0].timestamp_ns, seat)
        recording = server.get_scene_serializer()
        for number, leg in enumerate(legs):
            label.text = leg.title
            path = replace(drive.path, trajectory=leg.trajectory)
            for moment, (view, pause_s) in enumerate(zip(views, pauses_s, strict=True)):
                nodes.place(view.timestamp_ns, path.camera(moment))
                recording.insert_sleep(pause_s)
                progress(number * len(views) + moment + 1, len(legs) * len(views))
        return sealed_page(recording.as_html(), notes, _first_view(drive, nodes))


def _first_view(drive: ShownDrive, nodes: DriveNodes) -> FirstView:
    """Our own picture of what the page shows first, seen through a lens as high but wider."""
    width_px, height_px = FIRST_VIEW_PX
    seat, view = drive.path.camera(0), drive.path.views[0]
    focal_px = height_px / 2 / math.tan(vertical_fov_rad(seat) / 2)
    pose = seat.world_from_camera
    wide = Camera.centred(pose, focal_px, width_px=width_px, height_px=height_px)
    drawn = nodes.shown.scene.render(wide, view.timestamp_ns, camera_name=view.camera_name)
    return FirstView(data_url=jpeg_data_url(drawn.rgb), num_splats=nodes.shown.num_splats)
