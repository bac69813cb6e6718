"""Find who moves in a scene, and bring the scene with their boxes into the store."""

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from catalog.artefacts import Workplace
from catalog.store import Store, open_store
from lidarpainter_models.editing.track_edits import TrackEdits, edited_scores, edited_tracks
from lidarpainter_models.lidar.movers import FoundActor, box_of, find_movers, unboxed
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.frame_content import FrameContent
from lidarpainter_models.scenes.rewriting import (
    FURTHER_ENTRIES,
    header_of,
    track_boxes,
    write_anew,
)
from lidarpainter_models.scenes.schema import LABELLED
from lidarpainter_models.scenes.tracks import ActorTrack
from tasks.ingest.ingest import STAGE as WRITE
from tasks.ingest.ingest import record_scene, writing
from tasks.ingest.localise import require_free
from tasks.json_files import read_json
from tasks.opened import open_posed
from tasks.progress import Progress, progress_of
from tasks.stages import StageResult, run_stage, stage_task

STAGE = "label"
KIND = "labels"
FILE = "labels.json"
SUFFIX = "-labelled"
EDITED_SUFFIX = "-edited"


@stage_task
def label(store_path: Path, scene_id: str) -> StageResult:
    """Find who moves in a scene, whoever has boxes there already.

    Raises:
        SceneError: there is no such scene, or it has no poses.
    """
    store = open_store(store_path)
    scene = open_posed(store, scene_id)
    return run_stage(
        store,
        stage=STAGE,
        kind=KIND,
        inputs={"scene": scene.content_digest},
        config={},
        build=partial(_build, scene=scene),
    )


def compared(store: Store, scene_id: str, found: StageResult) -> list[dict[str, Any]]:
    """A row for everybody who was found, with who of the scene's boxes that is, and for others.

    Others are the scene's moving actors that were not found.
    """
    scene, actors = open_posed(store, scene_id), load_actors(store, found)
    rows, met = [], set()
    for actor in actors:
        given = box_of(actor.track, scene.tracks)
        met.add(given.actor_id if given else None)
        rows.append(_row(actor.track, actor.score, given))
    missed = [one for one in scene.tracks if one.is_moving and one.actor_id not in met]
    return [*rows, *({**_row(one, None, one), "found": None} for one in missed)]


@stage_task
def ingest_labelled(
    store_path: Path, scene_id: str, found: StageResult, sequence: str | None
) -> dict[str, Any]:
    """Write a scene with boxes of those who have none; returns its row in `scenes`.

    Args:
        store_path: where both scenes are.
        scene_id: whose movers were found; boxes that it has are kept.
        found: what `label` gave.
        sequence: name of the new scene in its dataset; that of the old one and a suffix if None.

    Raises:
        ConfigError: a scene of that name is there that was made otherwise.
    """
    store = open_store(store_path)
    scene = open_posed(store, scene_id)
    name = sequence or scene.sequence + SUFFIX
    actors = _named(unboxed(load_actors(store, found), scene.tracks), scene.tracks)
    tracks = [actor.track for actor in actors]
    scores = {actor.track.actor_id: actor.score for actor in actors}

    def completed(frame: FrameContent) -> FrameContent:
        return replace(frame, boxes=[*frame.boxes, *track_boxes(tracks, frame.frame_index)])

    scores = {**scene.manifest.get(LABELLED, {}), **scores}
    told = {"artefact": found.ref.artefact_id}
    return _with_boxes(store, scene, name, completed, scores, told)


@stage_task
def ingest_edited(
    store_path: Path, scene_id: str, edits: Path, sequence: str | None
) -> dict[str, Any]:
    """Write a scene with its boxes as a person changed them; returns its row in `scenes`.

    Args:
        store_path: where both scenes are.
        scene_id: whose boxes are changed.
        edits: the file that `view --label` wrote.
        sequence: name of the new scene in its dataset; that of the old one and a suffix if None.

    Raises:
        ConfigError: the file is no file of edits, its edits are of another scene, or a scene of
            that name was made otherwise.
    """
    store = open_store(store_path)
    scene = open_posed(store, scene_id)
    made = TrackEdits.read(edits, scene)
    tracks = edited_tracks(scene.tracks, made.edits, str(edits))
    name = sequence or scene.sequence + EDITED_SUFFIX
    scores = scene.manifest.get(LABELLED)
    if scores is not None:
        scores = edited_scores(scores, made.edits)

    def edited(frame: FrameContent) -> FrameContent:
        return replace(frame, boxes=track_boxes(tracks, frame.frame_index))

    return _with_boxes(store, scene, name, edited, scores, made.told)


def _with_boxes(
    store: Store,
    scene: DrivingScene,
    name: str,
    change: Callable[[FrameContent], FrameContent],
    scores: Mapping[str, float] | None,
    told: Mapping[str, Any],
) -> dict[str, Any]:
    """Write a scene under another name, with other boxes; returns its row in `scenes`.

    `scores` are those of boxes that were found, None where nobody sought any; `told` is how the
    boxes came to be.
    """
    require_free(store, scene, name, STAGE)
    entries = {key: scene.manifest[key] for key in FURTHER_ENTRIES if key in scene.manifest}
    header = header_of(scene, entries if scores is None else {**entries, LABELLED: dict(scores)})
    made_from = {"from": f"{scene.dataset}/{scene.sequence}", "digest": scene.content_digest}
    with writing(store, f"{scene.dataset}/{name}"):
        path = write_anew(
            *(scene, store.root, name, header, change, {STAGE: {**made_from, **told}}),
            progress=progress_of(WRITE),
        )
    return record_scene(store, path)


def label_by_hand(
    store: Store,
    scene_id: str,
    edits: Path,
    *,
    port: int | None,
    opened_at: Callable[[str], None],
    stopped: threading.Event,
) -> None:
    """Show a scene's boxes in a browser until stopped, and write what is changed about them.

    Args:
        store: where the scene is.
        scene_id: whose boxes are shown.
        edits: the file that is written, and read first where it is there.
        port: where to listen; None takes a free one.
        opened_at: told the address.
        stopped: ends the viewer when it is set.

    Raises:
        ConfigError: the port cannot be had, the file cannot be written, or is no file of edits of
            this scene.
    """
    from lidarpainter_models.viewing.label_viewer import LabelSession, label_viewer

    session = LabelSession(open_posed(store, scene_id), edits)
    with label_viewer(session, port=port) as address:
        opened_at(address)
        stopped.wait()


def load_actors(store: Store, found: StageResult) -> list[FoundActor]:
    """The actors of an artefact."""
    store.artefacts.verified(found.ref)
    return [_actor(values) for values in read_json(store.artefacts.files(found.ref) / FILE)]


def _build(place: Workplace, progress: Progress, *, scene: DrivingScene) -> dict[str, Any]:
    progress(0, 1, "who moves")
    actors = find_movers(scene)
    text = json.dumps([_values(actor) for actor in actors])
    (place.output / FILE).write_text(text + "\n", "utf-8")
    progress(1, 1, "")
    return {"num_actors": len(actors)}


def _values(actor: FoundActor) -> dict[str, Any]:
    track = actor.track
    return {
        "actor_id": track.actor_id,
        "category": track.category,
        "score": actor.score,
        "size_m": track.size_m.tolist(),
        "frame_indices": track.frame_indices.tolist(),
        "timestamps_ns": track.timestamps_ns.tolist(),
        "world_from_box": track.world_from_box.tolist(),
        "num_points": track.num_points.tolist(),
    }


def _actor(values: Mapping[str, Any]) -> FoundActor:
    track = ActorTrack(
        actor_id=values["actor_id"],
        category=values["category"],
        is_moving=True,
        size_m=torch.tensor(values["size_m"]),
        frame_indices=torch.tensor(values["frame_indices"]),
        timestamps_ns=torch.tensor(values["timestamps_ns"]),
        world_from_box=torch.tensor(values["world_from_box"], dtype=torch.float64),
        num_points=torch.tensor(values["num_points"]),
    )
    return FoundActor(track=track, score=values["score"])


def _named(actors: Sequence[FoundActor], known: Sequence[ActorTrack]) -> list[FoundActor]:
    """The actors under names that the scene has not given yet."""
    taken = {track.actor_id for track in known}
    free = (name for number in range(1, 10**6) if (name := f"found-{number:03d}") not in taken)
    return [
        replace(actor, track=replace(actor.track, actor_id=name))
        for actor, name in zip(actors, free, strict=False)
    ]


def _row(track: ActorTrack, score: float | None, given: ActorTrack | None) -> dict[str, Any]:
    seconds = float(track.timestamps_ns[-1] - track.timestamps_ns[0]) * 1e-9
    way_m = float((track.world_from_box[-1] - track.world_from_box[0])[:2, 3].norm())
    length_m, width_m, height_m = (round(one, 1) for one in track.size_m.tolist())
    return {
        "found": track.actor_id,
        "given": given.actor_id if given else None,
        "category": track.category,
        "length_m": length_m,
        "width_m": width_m,
        "height_m": height_m,
        "num_frames": len(track.frame_indices),
        "speed_mps": round(way_m / seconds, 1) if seconds else None,
        "score": score,
    }
