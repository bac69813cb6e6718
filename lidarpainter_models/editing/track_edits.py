"""What a person changes about the boxes of a scene: pieces joined, tracks cut, strangers deleted.

Edits are a JSON list that can be replayed on the tracks that they were made for. Each names actors
as they are called after the edits before it.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Int
from pydantic import AfterValidator, Field, TypeAdapter, model_validator
from torch import Tensor

from lidarpainter_models.editing.script import (
    MOST_OPERATIONS,
    Name,
    OperationWords,
    json_list,
    parsed_list,
)
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.scenes.schema import is_safe_name
from lidarpainter_models.scenes.tracks import ActorTrack, does_move
from lidarpainter_models.scenes.validation import require_label

Tracks = dict[str, ActorTrack]
"""By the id of the actor."""


def _is_id(name: str) -> str:
    if not is_safe_name(name):
        raise ValueError("expected letters, digits, '.', '_' or '-' for the id of an actor")
    return name


def _is_category(text: str) -> str:
    try:
        require_label(text, "edit")
    except DataError as error:
        raise ValueError(str(error)) from None
    return text


_Id = Annotated[Name, AfterValidator(_is_id)]
_Category = Annotated[Name, AfterValidator(_is_category)]


class Merge(OperationWords):
    """Tracks that are pieces of one actor become the first of them.

    It has the size of the piece whose boxes hold the most LiDAR points, and in a frame that several
    pieces have a box in, the box that holds the most.
    """

    op: Literal["merge"] = "merge"
    actors: Annotated[tuple[Name, ...], Field(min_length=2, strict=False)]

    @model_validator(mode="after")
    def _are_different(self) -> "Merge":
        if len(set(self.actors)) < len(self.actors):
            raise ValueError("expected every actor once")
        return self

    def changed(self, tracks: Tracks) -> Tracks:
        """The tracks with one in place of several."""
        pieces = [_known(tracks, name) for name in self.actors]
        left = {name: track for name, track in tracks.items() if name not in self.actors[1:]}
        return {**left, self.actors[0]: _merged(pieces)}


class Split(OperationWords):
    """From a frame on an actor is another one: two were taken for one."""

    op: Literal["split"] = "split"
    actor: Name
    frame: Annotated[int, Field(ge=0)]
    name: _Id
    """What it is called from that frame on."""

    def changed(self, tracks: Tracks) -> Tracks:
        """The tracks with one more."""
        track = _known(tracks, self.actor)
        _require_free(tracks, self.name)
        is_later = track.frame_indices >= self.frame
        if not bool(is_later.any()) or bool(is_later.all()):
            frames = track.frame_indices.tolist()
            raise ConfigError(
                f"{self.actor} has no boxes on both sides of frame {self.frame}: expected one of "
                f"{frames[0] + 1} to {frames[-1]}"
            )
        before, after = (_rows(track, part.nonzero()[:, 0]) for part in (~is_later, is_later))
        return {**tracks, self.actor: before, self.name: replace(after, actor_id=self.name)}


class Delete(OperationWords):
    """There is nobody: leaves, a wall, a reflection."""

    op: Literal["delete"] = "delete"
    actors: Annotated[tuple[Name, ...], Field(min_length=1, strict=False)]

    def changed(self, tracks: Tracks) -> Tracks:
        """The tracks without these."""
        for name in self.actors:
            _known(tracks, name)
        return {name: track for name, track in tracks.items() if name not in self.actors}


class Rename(OperationWords):
    """Call an actor otherwise, or say of which class it is."""

    op: Literal["rename"] = "rename"
    actor: Name
    name: _Id | None = None
    category: _Category | None = None

    @model_validator(mode="after")
    def _says_something(self) -> "Rename":
        if self.name is None and self.category is None:
            raise ValueError("expected name or category")
        return self

    def changed(self, tracks: Tracks) -> Tracks:
        """The tracks with one called otherwise."""
        track = _known(tracks, self.actor)
        name = self.name or self.actor
        if name != self.actor:
            _require_free(tracks, name)
        told = replace(track, actor_id=name, category=self.category or track.category)
        return {
            name if known == self.actor else known: told if known == self.actor else one
            for known, one in tracks.items()
        }


TrackEdit = Annotated[Merge | Split | Delete | Rename, Field(discriminator="op")]
_EDITS: TypeAdapter[tuple[TrackEdit, ...]] = TypeAdapter(
    Annotated[tuple[TrackEdit, ...], Field(strict=False, max_length=MOST_OPERATIONS)]
)


def read_track_edits(path: Path) -> tuple[TrackEdit, ...]:
    """Read a file of edits.

    Raises:
        ConfigError: it cannot be read, or is no list of edits; the message says which and why.
    """
    try:
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}") from None
    return parsed_list(_EDITS.validate_python, json_list(text, str(path)), str(path))


def track_edits_json(edits: Sequence[TrackEdit]) -> bytes:
    """The file that `read_track_edits` reads, an edit a line."""
    lines = ",\n".join(one.model_dump_json(exclude_none=True) for one in edits)
    return f"[\n{lines}\n]\n".encode() if edits else b"[]\n"


def edited_tracks(tracks: Sequence[ActorTrack], edits: Sequence[TrackEdit]) -> list[ActorTrack]:
    """Tracks after some edits, one after another.

    Raises:
        ConfigError: an edit names nobody, or somebody twice; the message says which edit.
    """
    known = {track.actor_id: track for track in tracks}
    for number, edit in enumerate(edits, start=1):
        try:
            known = edit.changed(known)
        except ConfigError as error:
            raise ConfigError(f"edit {number} ({edit.op}): {error}") from None
    return list(known.values())


def _known(tracks: Tracks, name: str) -> ActorTrack:
    if name not in tracks:
        raise ConfigError(f"there is no actor {name!r:.60} among {len(tracks)}")
    return tracks[name]


def _require_free(tracks: Tracks, name: str) -> None:
    if name in tracks:
        raise ConfigError(f"an actor is called {name!r:.60} already: expected another name")


def _merged(pieces: Sequence[ActorTrack]) -> ActorTrack:
    """One track of several, in each frame the box with the most points."""
    rows = [
        (frame, -points, number, row)
        for number, piece in enumerate(pieces)
        for row, (frame, points) in enumerate(
            zip(piece.frame_indices.tolist(), piece.num_points.tolist(), strict=True)
        )
    ]
    starts = torch.tensor([0, *(len(piece.frame_indices) for piece in pieces)]).cumsum(0)
    best = {frame: starts[number] + row for frame, _, number, row in sorted(rows, reverse=True)}
    chosen = torch.tensor([int(best[frame]) for frame in sorted(best)])
    fullest = max(pieces, key=lambda piece: int(piece.num_points.sum()))
    together = replace(
        pieces[0],
        size_m=fullest.size_m,
        frame_indices=torch.cat([piece.frame_indices for piece in pieces]),
        timestamps_ns=torch.cat([piece.timestamps_ns for piece in pieces]),
        world_from_box=torch.cat([piece.world_from_box for piece in pieces]),
        num_points=torch.cat([piece.num_points for piece in pieces]),
    )
    return _rows(together, chosen)


def _rows(track: ActorTrack, rows: Int[Tensor, " rows"]) -> ActorTrack:
    """Some of the boxes of a track; whether it moves is told anew."""
    poses = track.world_from_box[rows]
    return replace(
        track,
        is_moving=does_move(poses[:, :3, 3]),
        frame_indices=track.frame_indices[rows],
        timestamps_ns=track.timestamps_ns[rows],
        world_from_box=poses,
        num_points=track.num_points[rows],
    )
