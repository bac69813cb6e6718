"""`lidarpainter ingest`: from a dataset as downloaded to scenes in the store."""

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import complain, format_bytes, print_json, print_table, say_status
from flows.cli.shared_options import AsJson, described, parse_frames, parse_names
from lidarpainter_models.errors import ConfigError

SOME_FAILED = 2
COLUMNS = {
    "scene_id": "scene",
    "num_frames": "frames",
    "num_views": "images",
    "num_points": "points",
    "num_actors": "actors",
    "num_moving_actors": "moving",
}

WORDS = """
dataset: Form of the dataset: pandaset, nuscenes, waymo, av2 (Argoverse 2), kitti, ncore (NVIDIA's),
  mcap (a bag of ROS 2 or Foxglove), or canonical (scenes in the form that this store has).
root: The folder that holds the sequences, as downloaded; of a bag the file.
sequences: Names of the sequences to take; all that are found if none is named.
frames: Frames to take as A:B, B excluded, such as 0:40; all if absent.
cameras: Names of the cameras to take, with commas between; all if absent.
map_file: File that says which topics of a bag are which sensor, as lidarpainter rig proposes it; as
  proposed if absent.
jobs: Number of sequences read at once, each in a process of its own.
again: Read everything anew, and replace what is in the store.
"""


@described(WORDS)
def ingest(  # noqa: PLR0913 - one per option
    dataset: str,
    root: Path,
    sequences: Annotated[list[str] | None, typer.Argument()] = None,
    frames: str | None = None,
    cameras: str | None = None,
    map_file: Annotated[Path | None, typer.Option("--map")] = None,
    jobs: Annotated[int, typer.Option(min=1)] = 1,
    again: bool = False,
    as_json: AsJson = False,
) -> None:
    """Bring sequences of a dataset into the store.

    A sequence that is there as asked for is not read again. With other cameras, other frames or
    from another root it is refused, and --again replaces what is there.

    Example: lidarpainter ingest pandaset /data/pandaset 002 --cameras front_camera

    All segments, four at once: lidarpainter ingest waymo /data/waymo --jobs 4

    A bag: lidarpainter ingest mcap drive.mcap --map rig.toml
    """
    chosen_frames = parse_frames(frames)
    chosen_cameras = parse_names(cameras, "--cameras")
    if map_file is not None and not map_file.is_file():
        raise ConfigError(f"{map_file}: no such file, expected a rig.toml")

    say_status(f"looking for sequences in {root}")
    from catalog.store import open_store
    from flows.cli.progress import shown_progress
    from tasks.ingest.sequences import find_sequences

    store = open_store()
    names = find_sequences(dataset, root, sequences or ())
    from tasks.ingest.jobs import IngestRequest, ingest_sequences

    request = IngestRequest(
        store.address, dataset, root, chosen_frames, chosen_cameras, rig=map_file
    )
    with shown_progress():
        done = ingest_sequences(request, names, jobs=jobs, again=again, on_failure=complain)
    rows, failures = done.rows, done.failures
    if as_json:
        print_json({"store": store.name, "scenes": rows, "failures": failures})
    else:
        cells = [[*(row[name] for name in COLUMNS), format_bytes(row["num_bytes"])] for row in rows]
        print_table(f"scenes in {store.name}", [*COLUMNS.values(), "size"], cells)
    if failures:
        raise typer.Exit(SOME_FAILED)
