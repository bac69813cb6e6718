"""Options that several commands have, with the same meaning in each."""

from typing import Annotated

import typer

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
RunName = Annotated[str, typer.Argument(help="A run id, a unique prefix of one, or latest.")]
TrajectorySpec = Annotated[
    str, typer.Option(help="recorded, lateral:2, up:1.5, yaw:15, lane-change:3.5; parts with +.")
]
FollowedCamera = Annotated[
    str | None, typer.Option(help="Camera whose path is followed; the first if absent.")
]
FollowedFrames = Annotated[
    str | None, typer.Option(help="Recorded frames A:B to follow, B excluded.")
]
