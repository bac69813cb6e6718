"""The model of a spinning LiDAR as NCore has it: rows of beams, columns of steps of its head.

Columns are counted in the order in which they are fired, from where the head looks first.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt16, UInt64

from lidarpainter_models.lidar.sensors import LidarSensor


def first_azimuth_deg(
    sensor: LidarSensor,
    direction: Float[np.ndarray, "rays 3"],
    times_us: UInt64[np.ndarray, " rays"],
) -> float:
    """Where the head looks first: at the earliest ray of a turn, or at the edge of its sector."""
    if not _turns_round(sensor):
        return float(sensor.head_azimuth_deg(np.zeros(1))[0])
    return float(_rows_and_heads(sensor, direction)[1][times_us.argmin()])


def model_parameters(sensor: LidarSensor, first_deg: float) -> dict[str, Any]:
    """What `RowOffsetStructuredSpinningLidarModelParameters` takes; angles in radians."""
    columns_deg = first_deg + _way(sensor) * sensor.step_deg * np.arange(sensor.steps)
    return {
        "spinning_frequency_hz": 1.0 / sensor.turn_s,
        "spinning_direction": "ccw" if sensor.turns_left else "cw",
        "n_rows": sensor.num_beams,
        "n_columns": sensor.steps,
        "row_elevations_rad": np.radians(sensor.elevation_deg).astype(np.float32),
        "column_azimuths_rad": np.radians(_wrapped_deg(columns_deg)).astype(np.float32),
        "row_azimuth_offsets_rad": np.radians(sensor.beam_offsets_deg).astype(np.float32),
    }


def model_elements(
    sensor: LidarSensor, direction: Float[np.ndarray, "rays 3"], first_deg: float
) -> UInt16[np.ndarray, "rays 2"]:
    """The row and the column of the model that are nearest to each ray."""
    row, head_deg = _rows_and_heads(sensor, direction)
    column = np.rint((head_deg - first_deg) * _way(sensor) / sensor.step_deg).astype(np.int64)
    last = sensor.steps - 1
    column = column % sensor.steps if _turns_round(sensor) else column.clip(0, last)
    return np.stack([row, column], axis=1).astype(np.uint16)


def _rows_and_heads(
    sensor: LidarSensor, direction: Float[np.ndarray, "rays 3"]
) -> tuple[Int[np.ndarray, " rays"], Float[np.ndarray, " rays"]]:
    """The nearest row of each ray, of which the first looks highest, and where the head looks."""
    rows_deg = np.array(sensor.elevation_deg)[::-1]
    elevation_deg = np.degrees(np.arcsin(direction[:, 2].astype(np.float64).clip(-1, 1)))
    between_deg = (rows_deg[1:] + rows_deg[:-1]) / 2
    row = len(between_deg) - np.searchsorted(between_deg, elevation_deg)
    azimuth_deg = np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))
    return row, _wrapped_deg(azimuth_deg - sensor.beam_offsets_deg[row])


def _turns_round(sensor: LidarSensor) -> bool:
    return sensor.azimuths_deg[1] - sensor.azimuths_deg[0] >= 360


def _way(sensor: LidarSensor) -> float:
    return 1.0 if sensor.turns_left else -1.0


def _wrapped_deg(angle_deg: np.ndarray) -> np.ndarray:
    return np.remainder(angle_deg + 180, 360) - 180
