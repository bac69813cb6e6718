"""`lidarpainter lidar-model`: what the sweeps of a scene tell of their sensor."""

from pathlib import Path

from flows.cli.output import print_result
from flows.cli.shared_options import AsJson, described

WORDS = """
lidar: Name of the LiDAR in the log; its first if absent.
out: File that the sensor is written to, as `render --lidar` takes it.
"""


@described(WORDS)
def lidar_model(
    scene: str, lidar: str | None = None, out: Path | None = None, as_json: AsJson = False
) -> None:
    """Estimate where the beams of a scene's LiDAR look, its steps and how it leans.

    Example: lidarpainter lidar-model pandaset/002 --out pandar64.json
    """
    from catalog.store import existing_store
    from flows.lidar import sensor_of_scene

    result = sensor_of_scene(existing_store(), scene, lidar, out)
    print_result(f"LiDAR of {scene}", result, as_json=as_json)
