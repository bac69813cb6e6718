"""LiDARs as they are built: where each beam looks, how a turn is fired, and what comes back.

Sensor frame: x ahead, y left, z up; azimuths go counter-clockwise from ahead, elevations up. What
is not known of a sensor is estimated from its sweeps (`firings`); these presets are of public data
sheets.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lidarpainter_models.errors import ConfigError

MOST_BEAMS, MOST_STEPS = 1024, 65_536
MOST_FILE_BYTES = 1_000_000
KINDS = {"name": str, "turns_left": bool, "steps": int, "returns": int}
"""Fields that are neither numbers with a fraction nor lists of them."""
MOST_TURN_S, MOST_RANGE_M, MOST_DIVERGENCE_RAD = 10.0, 2000.0, 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarSensor:
    """One model of a LiDAR that turns, or that looks to one side by a mirror."""

    name: str
    elevation_deg: tuple[float, ...]
    """Where each beam looks, one entry per beam."""
    azimuth_offset_deg: tuple[float, ...] = ()
    """By how much each beam looks left of where the head does; empty where none does."""
    steps: int
    """How many times all beams are fired in a sweep, evenly over its azimuths."""
    turn_s: float = 0.1
    """How long a sweep takes."""
    turns_left: bool = False
    """Whether the head turns counter-clockwise, seen from above."""
    azimuths_deg: tuple[float, float] = (-180.0, 180.0)
    """From the rightmost to the leftmost azimuth of the head; a whole turn begins behind."""
    min_range_m: float = 0.3
    max_range_m: float = 200.0
    divergence_rad: float = 0.003
    """Full angle at which a beam widens."""
    returns: int = 1
    """How many returns of a ray are reported at most: 1, or 2, the strongest ones."""

    def __post_init__(self) -> None:
        """Refuse what no sensor is."""
        beams = len(self.elevation_deg)
        if not 1 <= beams <= MOST_BEAMS:
            raise ConfigError(f"sensor {self.name!r}: {beams} beams, expected 1 to {MOST_BEAMS}")
        if len(self.azimuth_offset_deg) not in (0, beams):
            raise ConfigError(
                f"sensor {self.name!r}: {len(self.azimuth_offset_deg)} azimuth offsets for "
                f"{beams} beams, expected none or one each"
            )
        if not 1 <= self.steps <= MOST_STEPS:
            raise ConfigError(f"sensor {self.name!r}: steps {self.steps}, expected 1 to 65536")
        first, last = self.azimuths_deg
        limits = (
            ("elevation_deg", min(self.elevation_deg), -90, 90),
            ("elevation_deg", max(self.elevation_deg), -90, 90),
            *(("azimuth_offset_deg", offset, -180, 180) for offset in self.azimuth_offset_deg),
            ("azimuths_deg", first, -180, 180),
            ("azimuths_deg", last, first, 180),
            ("turn_s", self.turn_s, 0, MOST_TURN_S),
            ("min_range_m", self.min_range_m, 0, self.max_range_m),
            ("max_range_m", self.max_range_m, self.min_range_m, MOST_RANGE_M),
            ("divergence_rad", self.divergence_rad, 0, MOST_DIVERGENCE_RAD),
            ("returns", self.returns, 1, 2),
        )
        for what, value, least, most in limits:
            if not (math.isfinite(value) and least <= value <= most):
                raise ConfigError(
                    f"sensor {self.name!r}: {what} {value:g}, expected {least:g} to {most:g}"
                )

    @property
    def num_beams(self) -> int:
        """How many beams there are."""
        return len(self.elevation_deg)

    @property
    def step_deg(self) -> float:
        """Azimuth between one firing of a beam and the next."""
        return (self.azimuths_deg[1] - self.azimuths_deg[0]) / self.steps

    @property
    def beam_offsets_deg(self) -> Float[np.ndarray, " beams"]:
        """By how much each beam looks left of the head."""
        return np.array(self.azimuth_offset_deg or (0.0,) * self.num_beams)

    def head_azimuth_deg(self, step: np.ndarray) -> np.ndarray:
        """Where the head looks at some steps, from the first azimuth it comes to."""
        turned = (np.asarray(step) + 0.5) * self.step_deg
        first, last = self.azimuths_deg
        return first + turned if self.turns_left else last - turned

    def directions(
        self, beam: np.ndarray, head_azimuth_deg: np.ndarray
    ) -> Float[np.ndarray, "rays 3"]:
        """Unit vectors of rays in the sensor frame, float64, one for each beam and head azimuth."""
        azimuth = np.radians(head_azimuth_deg + self.beam_offsets_deg[beam])
        elevation = np.radians(np.array(self.elevation_deg))[beam]
        flat = np.cos(elevation)
        return np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1
        )

    @property
    def shares(self) -> Float[np.ndarray, " steps"]:
        """How much of the sweep has passed when each step is fired."""
        return (np.arange(self.steps) + 0.5) / self.steps

    def to_record(self) -> dict[str, Any]:
        """What a sensor file holds."""
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in ((slot, getattr(self, slot)) for slot in self.__slots__)
        }


def sensor_from_record(record: object, where: str) -> LidarSensor:
    """A sensor of a file that somebody wrote.

    Raises:
        ConfigError: it is no sensor; says what, where and what was expected.
    """
    fields = set(LidarSensor.__slots__)
    if not isinstance(record, dict) or not {"name", "elevation_deg", "steps"} <= set(record):
        raise ConfigError(f"{where}: expected an object with name, elevation_deg and steps")
    if unknown := sorted(map(str, set(record) - fields)):
        raise ConfigError(f"{where}: {unknown[0]!r} is no field of a sensor ({', '.join(fields)})")
    values: dict[str, Any] = {}
    for name, value in record.items():
        values[name] = _checked(name, value, where)
    return LidarSensor(**values)


def _checked(name: str, value: object, where: str) -> object:
    """A field of a sensor file as the sensor takes it."""
    lists = {"elevation_deg": MOST_BEAMS, "azimuth_offset_deg": MOST_BEAMS, "azimuths_deg": 2}
    if name in KINDS:
        if type(value) is KINDS[name] and (name != "name" or 0 < len(str(value)) <= 80):
            return value
    elif name in lists and isinstance(value, list) and len(value) <= lists[name]:
        if all(_is_number(one) for one in value) and (name != "azimuths_deg" or len(value) == 2):
            return tuple(float(one) for one in value)
    elif _is_number(value) and name not in lists:
        return float(str(value))
    raise ConfigError(f"{where}: {name} cannot be {str(value)[:40]!r} of a sensor")


def _is_number(value: Any) -> bool:  # noqa: ANN401 - what a JSON file holds
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and abs(value) < 1e9


def _runs(*runs: tuple[float, float, int]) -> tuple[float, ...]:
    """Elevations from runs of equally spaced beams: the highest, the spacing, how many."""
    return tuple(
        round(highest_deg - step_deg * beam, 4)
        for highest_deg, step_deg, count in runs
        for beam in range(count)
    )


_PANDAR64_DEG = (
    *(14.882, 11.032, 8.059, 5.057, 3.04, 2.028, 1.86, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846),
    *(0.675, 0.508, 0.337, 0.169, 0.0, -0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184),
    *(-1.351, -1.522, -1.688, -1.86, -2.028, -2.198, -2.365, -2.536, -2.7, -2.873, -3.04, -3.21),
    *(-3.375, -3.548, -3.712, -3.884, -4.05, -4.221, -4.385, -4.558, -4.72, -4.892, -5.057),
    *(-5.229, -5.391, -5.565, -5.726, -5.898, -6.061, -7.063, -8.059, -9.06, -9.885, -11.032),
    *(-12.006, -12.974, -13.93, -18.889, -24.897),
)
_PANDAR64_LEFT_DEG = (
    *(1.042,) * 6,
    *(-1.042, -3.125, -5.208),
    *(5.208, 3.125, 1.042, -1.042, -3.125, -5.208) * 7,
    *(5.208, 3.125, 1.042),
    *(1.042,) * 10,
)

PRESETS: dict[str, LidarSensor] = {
    sensor.name: sensor
    for sensor in (
        LidarSensor(
            name="hdl-32e", elevation_deg=_runs((10.667, 4 / 3, 32)), steps=2170, max_range_m=100.0
        ),
        LidarSensor(
            name="hdl-64e",
            elevation_deg=_runs((2.0, 1 / 3, 32), (-8.833, 0.5, 32)),
            steps=2083,
            max_range_m=120.0,
            divergence_rad=0.002,
        ),
        LidarSensor(
            name="vlp-16", elevation_deg=_runs((15.0, 2.0, 16)), steps=1808, max_range_m=100.0
        ),
        LidarSensor(
            name="pandar64",
            elevation_deg=_PANDAR64_DEG,
            azimuth_offset_deg=_PANDAR64_LEFT_DEG,
            steps=1800,
        ),
        LidarSensor(
            name="pandar128",
            elevation_deg=_runs(
                (15.0, 0.56, 8), (10.5, 0.5, 17), (2.0, 0.125, 65), (-6.5, 0.5, 38)
            ),
            steps=1800,
        ),
        LidarSensor(
            name="at128",
            elevation_deg=_runs((12.7, 0.2, 128)),
            steps=1200,
            azimuths_deg=(-60.0, 60.0),
        ),
        LidarSensor(
            name="os1-128",
            elevation_deg=_runs((22.5, 45 / 127, 128)),
            steps=1024,
            min_range_m=0.5,
            max_range_m=170.0,
        ),
    )
}
"""Sensors by what `--lidar` calls them. Of Pandar128 and AT128 the sheets give spacings alone."""


def preset_of(name: str) -> LidarSensor | None:
    """The preset that a LiDAR's name in a log speaks of, or None."""
    return PRESETS.get(name.lower().replace("_", "-"))


def read_sensor(text: str) -> LidarSensor:
    """A preset by its name, or the sensor of a JSON file.

    Raises:
        ConfigError: there is no such preset or file, or the file holds no sensor.
    """
    if text in PRESETS:
        return PRESETS[text]
    path = Path(text)
    if path.suffix != ".json":
        raise ConfigError(f"sensor {text!r}: expected {', '.join(PRESETS)}, log, or a .json file")
    try:
        if path.stat().st_size > MOST_FILE_BYTES:
            raise ConfigError(f"{text}: larger than {MOST_FILE_BYTES} bytes, expected a sensor")
        record = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{text}: cannot be read as a sensor: {error}") from None
    return sensor_from_record(record, text)
