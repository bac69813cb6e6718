"""Which frames and cameras of a log are read."""

from collections.abc import Iterable

from lidarpainter_models.errors import DataError


def chosen_frames(num_frames: int, frames: slice | None, where: object) -> list[int]:
    """Positions of the frames asked for; all of them if None.

    Raises:
        DataError: none is left.
    """
    chosen = list(range(num_frames))[frames or slice(None)]
    if not chosen:
        raise DataError(f"{where}: the frames asked for select none of its {num_frames} frames")
    return chosen


def chosen_cameras(
    wanted: tuple[str, ...] | None, known: Iterable[str], where: object
) -> tuple[str, ...]:
    """Names of the cameras asked for, each once; all that are known if None.

    Raises:
        DataError: there is no such camera.
    """
    names = tuple(known)
    for name in wanted or ():
        if name not in names:
            raise DataError(f"{where}: no camera {name!r}, expected some of {', '.join(names)}")
    return names if wanted is None else tuple(dict.fromkeys(wanted))
