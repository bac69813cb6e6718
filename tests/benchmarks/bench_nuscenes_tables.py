"""How fast a large table of nuScenes is indexed, and in how much memory.

    python tests/benchmarks/bench_nuscenes_tables.py [--rows 1000000]

A `sample_data.json` of so many rows, written as nuScenes writes it, is indexed in a process of its
own; the memory is that process's peak beyond what it had before. v1.0-trainval has 2.6 million.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from own_process import in_own_process, peak_bytes
from rich.console import Console
from rich.table import Table

from lidarpainter_models.readers.nuscenes.tables import NuscenesTable

ROWS_PER_SAMPLE = 77
NUM_LOOKUPS = 1000


def write_table(path, num_rows):
    """Rows of the size and look of `sample_data`'s."""
    rng = np.random.default_rng(0)
    with path.open("w") as file:
        file.write("[\n")
        for number in range(num_rows):
            tokens = [rng.bytes(16).hex() for _ in range(4)]
            row = {
                "token": f"{number:032x}",
                "sample_token": f"{number // ROWS_PER_SAMPLE:032x}",
                "ego_pose_token": tokens[0],
                "calibrated_sensor_token": tokens[1],
                "timestamp": 1_532_402_927_647_951 + 20_000 * number,
                "fileformat": "jpg",
                "is_key_frame": number % 6 == 0,
                "height": 900,
                "width": 1600,
                "filename": f"sweeps/CAM_FRONT/n015-2018-07-24__CAM_FRONT__{number}.jpg",
                "prev": tokens[2],
                "next": tokens[3],
            }
            file.write((",\n" if number else "") + json.dumps(row, indent=0))
        file.write("\n]")


def measure(path, num_rows):
    before, start = peak_bytes(), time.process_time()
    table = NuscenesTable(path, "sample_token")
    indexed, memory = time.process_time() - start, peak_bytes() - before
    samples = np.random.default_rng(1).integers(num_rows // ROWS_PER_SAMPLE, size=NUM_LOOKUPS)
    start = time.process_time()
    found = sum(len(table.rows_with(f"{sample:032x}")) for sample in samples)
    looked_up = time.process_time() - start
    if found != NUM_LOOKUPS * ROWS_PER_SAMPLE:
        raise RuntimeError(f"{found} rows found, expected {NUM_LOOKUPS * ROWS_PER_SAMPLE}")
    return indexed, memory, looked_up


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    num_rows = parser.parse_args().rows
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sample_data.json"
        write_table(path, num_rows)
        size = path.stat().st_size
        indexed, memory, looked_up = in_own_process(measure, path, num_rows)
    table = Table("rows", "size", "indexed", "rows a second", "memory", "rows of a sample")
    table.add_row(
        f"{num_rows:,}",
        f"{size / 1e6:.0f} MB",
        f"{indexed:.1f} s",
        f"{num_rows / indexed:,.0f}",
        f"{memory / 1e6:.0f} MB",
        f"{1000 * looked_up / NUM_LOOKUPS:.2f} ms",
    )
    Console().print(table)


if __name__ == "__main__":
    main()
