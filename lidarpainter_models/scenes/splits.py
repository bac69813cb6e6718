"""Which recorded images a fit may see and which judge it.

A spec is one of
- `alternate`: every second frame trains, the others test (the paper's protocol);
- `linspace`: half of the frames, at even steps from the first to the last, train (neurad-studio's
  protocol on PandaSet: 0, 2 .. 76, 79 of 80);
- `forward:N:M`: every second of the first N frames trains, the last M frames test, farther along;
- `all`: every frame trains, nothing is held out.

Frames are split and not images, so what a held-out image shows was never seen by a neighbouring
camera at the same moment, and the LiDAR sweeps of test frames stay out as well. Every second frame
is meant of each camera's own images: where cameras take turns or one has images in every second
frame alone, each still has as many on either side.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView, ViewKey


@runtime_checkable
class Keyed(Protocol):
    """A view that is named by its frame and camera, recorded or prepared for a fit."""

    @property
    def key(self) -> ViewKey:
        """Frame and camera."""


Item = TypeVar("Item")
View = TypeVar("View", bound=Keyed)

SPECS = "alternate, linspace, forward:N:M or all"


@dataclass(frozen=True, kw_only=True)
class ViewSplit:
    """Recorded views on both sides of a split, in frame order."""

    train: tuple[RecordedView, ...]
    test: tuple[RecordedView, ...]
    train_frames: tuple[int, ...]
    """Frames whose images and sweeps may be used."""
    test_frames: tuple[int, ...]


def split_views(
    scene: DrivingScene, spec: str, cameras: tuple[str, ...] | None = None
) -> ViewSplit:
    """Split a scene's views, of some cameras or all, by a spec.

    Raises:
        ConfigError: the spec is not understood or leaves no image to train on.
        SceneError: a camera is not in the scene.
    """
    for name in cameras or ():
        if name not in scene.camera_names:
            raise SceneError(
                f"{scene.path}: no camera {name!r}; it has {', '.join(scene.camera_names)}"
            )
    chosen = [view for view in scene.views if cameras is None or view.camera_name in cameras]
    seen_by: dict[int, list[str]] = {}
    for view in chosen:
        seen_by.setdefault(view.frame_index, []).append(view.camera_name)
    train_frames, test_frames = split_frames(scene.frame_indices, spec, seen_by)
    return ViewSplit(
        train=tuple(view for view in chosen if view.frame_index in set(train_frames)),
        test=tuple(view for view in chosen if view.frame_index in set(test_frames)),
        train_frames=train_frames,
        test_frames=test_frames,
    )


def sampled_views(views: Sequence[View], most_views: int) -> tuple[View, ...]:
    """So many of some views at most, each camera's evenly over time, in the order they came in.

    Args:
        views: each camera's in order of time, however the cameras take turns.
        most_views: at least 1; where there are more cameras than that, one view of each is taken.
    """
    return tuple(views[row] for row in sampled_rows([view.key[1] for view in views], most_views))


def sampled_rows(cameras: Sequence[str], most: int) -> list[int]:
    """The same for views of which only the cameras are named: which of them to take."""
    if len(cameras) <= most:
        return list(range(len(cameras)))
    return rows_of_each(cameras, max(most // len(set(cameras)), 1))


def rows_of_each(cameras: Sequence[str], most: int) -> list[int]:
    """Which of some views to take: so many of each camera at most, evenly over time, in order.

    Every n-th view would not do: cameras take turns, and a step that has a factor in common with
    their number passes over some of them.
    """
    by_camera: dict[str, list[int]] = {}
    for row, name in enumerate(cameras):
        by_camera.setdefault(name, []).append(row)
    return sorted(row for own in by_camera.values() for row in evenly_taken(own, most))


def evenly_taken(items: Sequence[Item], most: int) -> list[Item]:
    """So many of some items at most, from the middles of as many equal parts, in order."""
    count = min(most, len(items))
    return [items[(2 * place + 1) * len(items) // (2 * count)] for place in range(count)]


def split_frames(
    frame_indices: Sequence[int], spec: str, seen_by: Mapping[int, Sequence[str]] | None = None
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Training and test frames; positions count, whatever the frames are called.

    Args:
        frame_indices: the frames in order.
        spec: one of `SPECS`.
        seen_by: the cameras that have an image in each frame; None where all have one in all.

    Raises:
        ConfigError: the spec is not understood or leaves no frame, or no image, to train on.
    """
    frames = tuple(frame_indices)
    if seen_by is None:
        seen_by = dict.fromkeys(frames, ("all",))
    kind, *numbers = spec.split(":")
    if kind == "alternate" and not numbers:
        train, test = _every_second(frames, seen_by)
    elif kind == "linspace" and not numbers:
        trains = set(np.linspace(0, len(frames) - 1, len(frames) // 2).astype(int).tolist())
        train, test = (
            tuple(frame for place, frame in enumerate(frames) if (place in trains) == is_train)
            for is_train in (True, False)
        )
    elif kind == "all" and not numbers:
        train, test = frames, ()
    elif kind == "forward" and len(numbers) == 2 and all(part.isdigit() for part in numbers):
        first, test = _forward(frames, *(int(part) for part in numbers))
        train, _ = _every_second(first, seen_by)
    else:
        raise ConfigError(f"split {spec!r} is not understood, expected {SPECS}")
    if not any(seen_by.get(frame) for frame in train):
        raise ConfigError(
            f"split {spec!r} leaves no frame with an image to train on ({len(frames)} frames)"
        )
    return train, test


def _every_second(
    frames: tuple[int, ...], seen_by: Mapping[int, Sequence[str]]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Frames that train and that test, so that every camera has as many images on either side.

    A frame tests where its cameras, taken together, have trained more often than tested by more
    than half of their number. One without an image trains.
    """
    sides: tuple[list[int], list[int]] = ([], [])
    ahead: Counter[str] = Counter()
    for frame in frames:
        cameras = seen_by.get(frame, ())
        does_test = sum(ahead[name] for name in cameras) > len(cameras) / 2
        sides[does_test].append(frame)
        ahead.update(dict.fromkeys(cameras, -1 if does_test else 1))
    return tuple(sides[0]), tuple(sides[1])


def _forward(
    frames: tuple[int, ...], num_first: int, num_last: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The first frames and the last."""
    if num_first < 1 or num_last < 1 or num_first + num_last > len(frames):
        raise ConfigError(
            f"split forward:{num_first}:{num_last} needs at least one frame on each side and no "
            f"overlap, the scene has {len(frames)} frames"
        )
    return frames[:num_first], frames[-num_last:]
