"""How fast a log becomes a scene, from the page cache: PandaSet 002 with six cameras, or another.

    PYTHONPATH=. python tests/benchmarks/bench_ingest.py ROOT [--dataset pandaset]
        [--sequence 002] [--runs 3] [--serial]

Reads every file once, then ingests the sequence several times into a folder that is removed.
Prints frames per second (wall time means something on idle cores alone, CPU time always), the peak
resident set of the process, and the digest of what was stored. `--serial` also ingests with no
frame read ahead and fails if that gives another digest.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from lidarpainter_models.readers import known_datasets, open_log
from lidarpainter_models.readers.source_logs.log import NUM_AHEAD, write_log
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.measuring import measured


def ingest(dataset, root, sequence, num_ahead):
    """Wall seconds, cost and digest of one ingest."""
    with tempfile.TemporaryDirectory() as store, measured() as cost:
        started = time.perf_counter()
        path = write_log(open_log(dataset, root, sequence), Path(store), num_ahead=num_ahead)
        seconds = time.perf_counter() - started
        scene = DrivingScene.open(path)
    return seconds, cost, scene


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path, help="folder that holds the sequences")
    parser.add_argument("--dataset", choices=known_datasets(), default="pandaset")
    parser.add_argument("--sequence", default="002")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--serial", action="store_true", help="compare with a serial ingest")
    options = parser.parse_args()
    folder = options.root / options.sequence
    for file in (folder if folder.is_dir() else options.root).rglob("*.*"):
        if file.is_file():
            file.read_bytes()
    digests = set()
    for num_ahead in [NUM_AHEAD] * options.runs + [0] * options.serial:
        seconds, cost, scene = ingest(options.dataset, options.root, options.sequence, num_ahead)
        digests.add(scene.content_digest)
        frames, images = len(scene.frame_indices), len(scene.views)
        sys.stdout.write(
            f"{num_ahead} frames ahead: {frames / seconds:.1f} frames/s "
            f"({images / seconds:.0f} images/s), {seconds:.2f} s wall, {cost.cpu_seconds:.2f} s "
            f"CPU, peak {cost.peak_memory_bytes / 1e6:.0f} MB, {scene.content_digest[:12]}\n"
        )
    sys.exit(f"different digests: {digests}" if len(digests) > 1 else 0)


if __name__ == "__main__":
    main()
