"""`lidarpainter drive`: a policy in a recorded street, its cameras rendered as it moves."""

import re
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, print_pairs
from flows.cli.shared_options import AsJson, described, named_run
from lidarpainter_models.errors import ConfigError

MOST_ASIDE_M = 20.0

WORDS = """
drive.run: The run that is driven in, and rendered if nobody else renders: its id or the beginning
  of it, a scene such as pandaset/002 (its newest run), or latest (the newest run of all).
policy: Who drives: lane-keep (the middle of the lane), log (as recorded), idm (keeps its distance),
  or a Python file with a function drive(observation) that returns acceleration in m/s2 and steering
  in radians.
against: Renderer that is asked for the images, as HOST:PORT; a server of this run if absent.
out: Folder that drive.mp4, the film, is written to.
start: When to begin, in seconds of the log: the car is as fast then as the recording one was.
seconds: How long to drive; until the log ends if absent.
lane_change: Metres to the left of its line that the policy is to drive, after some seconds;
  negative is to the right.
drive.width: Width of the images that are asked for, in pixels.
"""


@described(WORDS)
def drive(  # noqa: PLR0913 - the options of a command
    run: str,
    policy: Annotated[str, typer.Option()] = "lane-keep",
    against: str | None = None,
    out: Path = Path("drive"),
    start: Annotated[float, typer.Option(min=0)] = 0.0,
    seconds: float | None = None,
    lane_change: float = 0.0,
    width: Annotated[int, typer.Option(min=32, max=4096)] = 480,
    as_json: AsJson = False,
) -> None:
    """Drive a policy through a finished run: a closed loop in one command.

    The cameras are asked for over gRPC, as a simulator asks; others drive as they were recorded.

    Example: lidarpainter drive latest --policy idm --lane-change 3.5 --out drive
    """
    from lidarpainter_models.serving.policies import check_policy

    check_policy(policy)
    if against is not None and not re.fullmatch(r"[\w.\[\]:-]+:\d{1,5}", against, re.ASCII):
        raise ConfigError(f"--against {against!r}: expected HOST:PORT")
    if not abs(lane_change) <= MOST_ASIDE_M:
        raise ConfigError(f"--lane-change {lane_change:g}: expected at most {MOST_ASIDE_M:g} m")
    run_id = named_run(run)
    from catalog.store import existing_store
    from flows.cli.progress import shown_progress
    from flows.drive import DriveRequest, drive_run
    from flows.interruption import starts_anew

    starts_anew("the drive")
    request = DriveRequest(
        policy=policy,
        against=against,
        start_s=start,
        seconds=seconds,
        lane_change_m=lane_change,
        width_px=width,
    )
    with shown_progress():
        result = drive_run(existing_store(), run_id, request, out.absolute())
    if as_json:
        print_json(result)
        return
    met = "; ".join(f"{one['obstacle']} at {one['from_s']:.1f} s" for one in result["collisions"])
    print_pairs(f"{policy} in {result['scene']}", {**result, "collisions": met or "none"})
