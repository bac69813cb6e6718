"""What a person changes about the boxes of a scene: pieces joined, tracks cut, strangers deleted.

A file of edits is a JSON object that names the scene whose tracks they were made for, so that they
are replayed on these alone. Each edit names actors as they are called after the edits before it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Int
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

from lidarpainter_models.editing.script import MOST_OPERATIONS, Name, OperationWords, parsed
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack, does_move
from lidarpainter_models.scenes.validation import require_label, require_name

Tracks = dict[str, ActorTrack]
"""By the id of the actor."""


_Id = Annotated[Name, AfterValidator(partial(require_name, kind="actor"))]
_Category = Annotated[Name, AfterValidator(partial(require_label, where="edit"))]


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

    def heirs(self, name: str) -> tuple[str, ...]:
        """What an actor is called afterwards."""
        return (self.actors[0] if name in self.actors else name,)


class Split(OperationWords):
    """From a frame on an actor is another one: two were taken for one."""

    op: Literal["split"] = "split"
    actor: Name
    frame: Annotated[int, Field(ge=0, le=2**31)]
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

    def heirs(self, name: str) -> tuple[str, ...]:
        """What an actor is called afterwards: one that is cut has two names."""
        return (name, self.name) if name == self.actor else (name,)


class Delete(OperationWords):
    """There is nobody: leaves, a wall, a reflection."""

    op: Literal["delete"] = "delete"
    actors: Annotated[tuple[Name, ...], Field(min_length=1, strict=False)]

    def changed(self, tracks: Tracks) -> Tracks:
        """The tracks without these."""
        for name in self.actors:
            _known(tracks, name)
        return {name: track for name, track in tracks.items() if name not in self.actors}

    def heirs(self, name: str) -> tuple[str, ...]:
        """What an actor is called afterwards: one that is deleted has no name."""
        return () if name in self.actors else (name,)


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

    def heirs(self, name: str) -> tuple[str, ...]:
        """What an actor is called afterwards."""
        return (self.name or name,) if name == self.actor else (name,)


TrackEdit = Annotated[Merge | Split | Delete | Rename, Field(discriminator="op")]
MOST_BYTES = 10_000_000


class TrackEdits(OperationWords):
    """Edits in the order in which they were made, and the scene that they were made for."""

    scene: Name
    """Its id."""
    digest: Name
    """Of its content."""
    edits: Annotated[tuple[TrackEdit, ...], Field(strict=False, max_length=MOST_OPERATIONS)] = ()

    @classmethod
    def begun(cls, scene: DrivingScene) -> "TrackEdits":
        """No edit yet."""
        return cls(scene=f"{scene.dataset}/{scene.sequence}", digest=scene.content_digest)

    @classmethod
    def read(cls, path: Path, scene: DrivingScene) -> "TrackEdits":
        """The edits of a scene that a file holds.

        Raises:
            ConfigError: it cannot be read, holds something else, or edits of another scene; the
                message says what and where.
        """
        try:
            if path.stat().st_size > MOST_BYTES:
                raise ConfigError(f"{path}: expected at most {MOST_BYTES / 1e6:g} MB of edits")
            found = json.loads(path.read_bytes())
        except (OSError, ValueError, RecursionError) as error:
            raise ConfigError(f"{path} is no file of edits: {error}") from None
        edits = parsed(cls.model_validate, found, str(path))
        if edits.digest != scene.content_digest:
            raise ConfigError(
                f"{path} holds edits of {edits.scene} (content {edits.digest:.12}), expected those "
                f"of {scene.dataset}/{scene.sequence} (content {scene.content_digest:.12})"
            )
        return edits

    def with_edits(self, edits: Sequence[TrackEdit]) -> "TrackEdits":
        """Other edits of the same scene.

        Raises:
            ConfigError: they are too many.
        """
        if len(edits) > MOST_OPERATIONS:
            raise ConfigError(f"{len(edits)} edits: expected at most {MOST_OPERATIONS}")
        return self.model_copy(update={"edits": tuple(edits)})

    @property
    def told(self) -> dict[str, Any]:
        """As JSON has it."""
        return self.model_dump(mode="json", exclude_none=True)

    @property
    def file(self) -> bytes:
        """What `read` reads, an edit a line."""
        told = self.told
        lines = ",\n".join(json.dumps(one) for one in told.pop("edits"))
        head = json.dumps({**told, "edits": []})
        return f"{head[:-2]}\n{lines}\n]}}\n".encode()


def edited_scores(scores: Mapping[str, float], edits: Sequence[TrackEdit]) -> dict[str, float]:
    """Scores of actors by what these are called after some edits; of merged ones the best."""
    known = dict(scores)
    for edit in edits:
        passed: dict[str, float] = {}
        for name, score in known.items():
            for heir in edit.heirs(name):
                passed[heir] = max(score, passed.get(heir, score))
        known = passed
    return known


def edited_tracks(
    tracks: Sequence[ActorTrack], edits: Sequence[TrackEdit], where: str
) -> list[ActorTrack]:
    """Tracks after some edits, one after another.

    Raises:
        ConfigError: an edit names nobody, or somebody twice; the message says `where` they come
            from and which it is.
    """
    known = {track.actor_id: track for track in tracks}
    for number, edit in enumerate(edits, start=1):
        try:
            known = edit.changed(known)
        except ConfigError as error:
            raise ConfigError(f"{where} operation {number}, {edit.op}: {error}") from None
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
