"""How far a fit is by what its steps cost, and how many of them a limit of time has room for."""

import time

from lidarpainter_models.gaussians.fitting.config import FitConfig

HALF_STEP = 0.6
"""What a step at half the image size costs of one at full size: 0.46 in images 960 pixels wide, in
smaller ones 0.72, as Gaussians cost more than pixels there (docs/decisions/length-of-a-fit.md)."""


def work_of(step: int, config: FitConfig, steps: int | None = None) -> float:
    """Return what the first `step` steps of so many in all cost, in steps at full image size."""
    steps = config.steps if steps is None else steps
    return step - (1 - HALF_STEP) * min(step, config.half_resolution * steps)


def steps_within(work: float, step: int, config: FitConfig) -> int:
    """Return how many steps there may be in all, so that those after `step` cost so much `work`.

    The planned steps are the most; of fewer steps, the part at half size is shorter too.
    """
    half = config.half_resolution
    steps = (work + HALF_STEP * step) / (HALF_STEP * half + 1 - half)
    if steps * half < step:
        steps = step + max(work, 0.0)
    return min(config.steps, int(steps))


class FitClock:
    """How many steps the time has room for, by how long those of this process took."""

    def __init__(self, step: int, config: FitConfig) -> None:
        """Start before the given step; a fit that is taken up again has its time once more."""
        self._first, self._config, self._began_s = step, config, time.monotonic()

    def steps_in_time(self, step: int, steps: int) -> int:
        """Return how many steps the fit has in all, of `steps` so far, after `step` of them."""
        limit_s = self._config.time_limit_s
        if limit_s is None or step <= self._first:
            return steps
        gone_s = time.monotonic() - self._began_s
        done = work_of(step, self._config, steps) - work_of(self._first, self._config, steps)
        return min(steps, steps_within((limit_s - gone_s) * done / gone_s, step, self._config))
