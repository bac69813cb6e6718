"""How fast a log becomes a scene, from the page cache: PandaSet 002 with six cameras, or another.

    PYTHONPATH=. python tests/benchmarks/bench_ingest.py ROOT [--dataset pandaset]
        [--sequence 002] [--runs 3]

Reads every file once, then ingests the sequence several times into a folder that is removed.
Prints frames per second (wall time means something on idle cores alone, CPU time always), the peak
resident set of the process, and the digest of what was stored.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from lidarpainter_models.readers import ingest_scene, known_datasets
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.measuring import measured


def ingest(dataset, root, sequence):
    """Wall seconds, cost and digest of one ingest."""
    with tempfile.TemporaryDirectory() as store, measured() as cost:
        started = time.perf_counter()
        path = ingest_scene(dataset, root, sequence, Path(store))
        seconds = time.perf_counter() - started
        scene = DrivingScene.open(path)
    return seconds, cost, scene


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path, help="folder that holds the sequences")
    parser.add_argument("--dataset", choices=known_datasets(), default="pandaset")
    parser.add_argument("--sequence", default="002")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    folder = options.root / options.sequence
    for file in (folder if folder.is_dir() else options.root).rglob("*.*"):
        if file.is_file():
            file.read_bytes()
    digests = set()
    for _ in range(options.runs):
        seconds, cost, scene = ingest(options.dataset, options.root, options.sequence)
        digests.add(scene.content_digest)
        frames, images = len(scene.frame_indices), len(scene.views)
        sys.stdout.write(
            f"{frames / seconds:.1f} frames/s "
            f"({images / seconds:.0f} images/s), {seconds:.2f} s wall, {cost.cpu_seconds:.2f} s "
            f"CPU, peak {cost.peak_memory_bytes / 1e6:.0f} MB, {scene.content_digest[:12]}\n"
        )
    sys.exit(f"different digests: {digests}" if len(digests) > 1 else 0)


if __name__ == "__main__":
    main()
