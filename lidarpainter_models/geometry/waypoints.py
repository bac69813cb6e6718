"""Waypoints: a path that a user wrote down, as a table of places.

A CSV file with a header: `x_m,y_m` in the world, if wanted `z_m`, `yaw_deg` (left of x is positive)
and `time_s` since the log began. Without times the places are spread evenly over the log; without
a yaw the body heads along its path. Between places the path is smooth (monotone cubic).
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from lidarpainter_models.errors import ConfigError

REQUIRED = ("x_m", "y_m")
OPTIONAL = ("time_s", "z_m", "yaw_deg")
MOST_PLACES = 100_000
FARTHEST_M = 100_000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Waypoints:
    """Places in the order they are passed."""

    xy_m: Float[Tensor, "places 2"]
    time_s: Float[Tensor, " places"] | None
    z_m: Float[Tensor, " places"] | None
    yaw_rad: Float[Tensor, " places"] | None

    def columns_at(
        self, seconds: Float[Tensor, " moments"], log_s: float
    ) -> dict[str, Float[Tensor, " moments"]]:
        """`x_m`, `y_m` and what else is given at some times of a log of this length.

        Before the first and after the last place the body stands there.
        """
        given = self.time_s
        times = torch.linspace(0, log_s, len(self.xy_m)) if given is None else given
        wanted = seconds.clamp(float(times[0]), float(times[-1])).numpy()
        columns = {"x_m": self.xy_m[:, 0], "y_m": self.xy_m[:, 1]}
        columns |= {"z_m": self.z_m} if self.z_m is not None else {}
        if self.yaw_rad is not None:
            columns["yaw_rad"] = torch.from_numpy(np.unwrap(self.yaw_rad.numpy()))
        return {
            name: torch.from_numpy(PchipInterpolator(times.double().numpy(), value)(wanted))
            for name, value in columns.items()
        }


def read_waypoints(path: Path) -> Waypoints:
    """Read a table of places.

    Raises:
        ConfigError: it cannot be read, lacks a column, or holds something that is no number.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            names = [name.strip() for name in reader.fieldnames or ()]
            _check_header(path, names)
            reader.fieldnames = names
            rows = [row for row, _ in zip(reader, range(MOST_PLACES + 1), strict=False)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"waypoints {path} cannot be read: {error}") from None
    if not 2 <= len(rows) <= MOST_PLACES:
        raise ConfigError(f"waypoints {path}: {len(rows)} places, expected 2 to {MOST_PLACES}")
    values = {name: _column(path, rows, name) for name in names}
    times = values.get("time_s")
    if times is not None and bool((times[1:] <= times[:-1]).any()):
        raise ConfigError(f"waypoints {path}: time_s does not ascend")
    yaw = values.get("yaw_deg")
    return Waypoints(
        xy_m=torch.stack([values["x_m"], values["y_m"]], dim=1),
        time_s=times,
        z_m=values.get("z_m"),
        yaw_rad=None if yaw is None else yaw.deg2rad(),
    )


def _check_header(path: Path, names: list[str]) -> None:
    known = {*REQUIRED, *OPTIONAL}
    if not set(REQUIRED) <= set(names) <= known or len(set(names)) != len(names):
        raise ConfigError(
            f"waypoints {path}: columns {', '.join(names) or 'none'}, expected "
            f"{', '.join(REQUIRED)} and if wanted {', '.join(OPTIONAL)}"
        )


def _column(path: Path, rows: list[dict[str, str]], name: str) -> Float[Tensor, " places"]:
    try:
        values = torch.tensor([float(row[name]) for row in rows], dtype=torch.float64)
    except (TypeError, ValueError):
        raise ConfigError(
            f"waypoints {path}: column {name} holds something else than a number"
        ) from None
    if not bool((values.abs() <= FARTHEST_M).all()):  # False for NaN too
        raise ConfigError(
            f"waypoints {path}: column {name} holds a value beyond {FARTHEST_M:g}, or no number"
        )
    return values
