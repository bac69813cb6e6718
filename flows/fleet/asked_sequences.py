"""What a manifest asks for, sequence by sequence: found, named, and with full parameters.

Globs are matched against what lies below a root now. Two sources may ask for one scene with
different cameras: it is read once with all of them, and each run trains on its own.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import cycle, product
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

import lidarpainter_models
from catalog.digests import canonical_json, digest_text, plain
from catalog.errors import UnknownRecordError
from catalog.fleets import Wish
from catalog.folders import expanded
from catalog.store import split_scene_id
from flows.fleet.manifest import STORED, SYNTHETIC, Manifest, Source, range_of
from flows.overrides import with_changes, with_overrides
from flows.parameters import ReconstructParameters
from flows.presets import preset as preset_named
from flows.recall import START
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.painter.styles import check_prompt
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, SyntheticStreetConfig
from tasks.ingest.bucket_roots import is_in_bucket
from tasks.ingest.sequences import find_scene_id, find_sequences
from tasks.specs import street_id
from tasks.stages import code_behind
from tasks.weights import file_digests

MAX_SEQUENCES = 100_000
FITS = ("fit", "refine")
_WILD = "*?["


class Asked(BaseModel):
    """One sequence: all that a worker needs to know, kept in the catalog as JSON."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dataset: str
    sequence: str
    scene: str | None = None
    """What it is called in the store, if that could be read and may be another name than these."""
    root: Path | None = None
    rig: Path | None = None
    """The map of a bag, if one is given."""
    frames: tuple[int, int] | None = None
    seed: int | None = None
    width_px: int | None = None
    read_cameras: tuple[str, ...] | None = None
    """Cameras to bring into the store; None takes all."""
    cameras: tuple[str, ...] | None = None
    """Cameras to train on; None takes all."""
    preset: str
    painter: str | None = None
    settings: tuple[str, ...] = ()
    configuration: str | None = None
    """Name of the way that it is made in, where there are several."""
    fit_seed: int = 0
    scores: bool = True
    examination: bool = False
    report: bool = True
    assets: bool = False
    variants: tuple[str, ...] = ()
    """Styles to make runs in."""

    @property
    def scene_id(self) -> str:
        """`<dataset>/<sequence>` in the store."""
        return self.scene or f"{self.dataset}/{self.sequence}"

    @cached_property
    def parameters(self) -> ReconstructParameters:
        """The parameters of its run.

        Raises:
            ConfigError: there is no such preset or setting.
        """
        changes: dict[str, Any] = {
            "judge": self.scores,
            "examine": self.examination,
            "report": self.report,
        }
        changes |= {"train_cameras": self.cameras} if self.cameras else {}
        changes |= {"painter": self.painter} if self.painter else {}
        chosen = with_changes(preset_named(self.preset, self.scene_id), changes)
        seeded = {name: replace(getattr(chosen, name), seed=self.fit_seed) for name in FITS}
        return with_overrides(with_changes(chosen, seeded), self.settings)

    @property
    def is_stored(self) -> bool:
        """Whether it is made of a scene that the store has to have already."""
        return self.seed is None and self.root is None

    @property
    def street(self) -> SyntheticStreetConfig:
        """The street, of a sequence that has a seed."""
        changes: dict[str, Any] = {}
        if self.read_cameras is not None:
            changes["cameras"] = tuple(
                camera for camera in DEFAULT_CAMERAS if camera.name in self.read_cameras
            )
        if self.frames is not None:
            changes["num_frames"] = self.frames[1]
        if self.width_px is not None:
            usual = SyntheticStreetConfig(seed=0)
            height_px = round(self.width_px * usual.height_px / usual.width_px)
            changes |= {"width_px": self.width_px, "height_px": max(height_px, 8)}
        return SyntheticStreetConfig(seed=self.seed or 0, **changes)


def wishes(manifest: Manifest, folder: Path) -> list[Wish]:
    """What a manifest asks for, as the catalog keeps it; relative roots count from `folder`.

    Raises:
        ConfigError: a variant is no style, or a source asks for what is not there or cannot be;
            see also `Asked.parameters`.
        DataError: a root holds no sequence.
        WeightsError: the painter or the weights of a perceptual distance cannot be used.
    """
    for variant in manifest.variants:
        check_prompt(variant)
    found = [
        (source, asked)
        for number, source in enumerate(manifest.source, start=1)
        for asked in _of_source(manifest, source, folder, f"[[source]] {number}")
    ]
    number = len(found) * max(len(manifest.configuration), 1) * len(manifest.fit_seeds)
    if number > MAX_SEQUENCES:
        raise ConfigError(f"{number} sequences are asked for, expected at most {MAX_SEQUENCES}")
    read = _with_shared_reading([one for _, one in found])
    sources = [source for source, _ in found]
    # neighbours are of different scenes: workers wait for no fit that two of them need
    asked = [
        one.model_copy(update={**changes, "settings": (*one.settings, *more)})
        for changes, more in _ways(manifest)
        for one in read
    ]
    weights: dict[tuple[str, str], list[Any]] = {}
    code = [code_behind(START).digest, lidarpainter_models.__version__]
    budget = canonical_json(manifest.budget)
    return [
        Wish(
            fleet=manifest.name,
            scene_id=one.scene_id,
            cameras=one.cameras,
            configuration=one.configuration,
            fit_seed=one.fit_seed,
            position=position,
            priority=source.priority,
            variants=manifest.variants,
            asked=one.model_dump_json(),
            asked_digest=digest_text(
                canonical_json([plain(one), plain(one.parameters), _weights(one, weights)])
            ),
            code_digest=digest_text(canonical_json(code)),
            budget=budget,
        )
        for position, (one, source) in enumerate(zip(asked, cycle(sources), strict=False))
    ]


def _ways(manifest: Manifest) -> Iterator[tuple[dict[str, Any], tuple[str, ...]]]:
    """What every configuration with every seed changes of a sequence, and its further settings."""
    for way, fit_seed in product(manifest.configuration or (None,), manifest.fit_seeds):
        if way is None:
            yield {"fit_seed": fit_seed}, ()
            continue
        changes = {} if way.preset is None else {"preset": way.preset}
        # after the manifest's settings, which may name a painter too
        painter = () if way.painter is None else (f"painter={way.painter}",)
        named = {"configuration": way.name, "fit_seed": fit_seed}
        yield {**changes, **named}, (*painter, *way.settings)


def _weights(asked: Asked, known: dict[tuple[str, str], list[Any]]) -> list[Any]:
    """Digests of what is learned, read once for each choice of files."""
    painter, files = asked.parameters.painter, asked.parameters.evaluation_config.weight_files
    key = painter, str(sorted(files.items()))
    if key not in known:
        known[key] = [PainterChoice.of(painter).digest, file_digests(files)]
    return known[key]


def _of_source(manifest: Manifest, source: Source, folder: Path, table: str) -> Iterator[Asked]:
    same: dict[str, Any] = {
        "dataset": source.dataset,
        "cameras": source.cameras,
        "preset": manifest.preset,
        "painter": manifest.painter,
        "settings": manifest.settings,
        "scores": "scores" in manifest.publish,
        "examination": "examination" in manifest.publish,
        "report": "report" in manifest.publish,
        "assets": "assets" in manifest.publish,
        "variants": manifest.variants,
    }
    if source.frames is not None:
        chosen = range_of(source.frames)
        same["frames"] = (chosen.start, chosen.stop)
    if source.dataset == SYNTHETIC:
        yield from _streets(source, same, table)
        return
    if source.dataset == STORED:
        for scene in source.scenes or ():
            dataset, _, name = scene.partition("/")
            yield Asked(sequence=name, **{**same, "dataset": dataset})
        return
    yield from _logs(source, same, folder, table)


def _logs(source: Source, same: dict[str, Any], folder: Path, table: str) -> Iterator[Asked]:
    root = _from(folder, source.root or "")
    same["rig"] = None if source.map is None else _from(folder, source.map)
    if same["rig"] is not None and not same["rig"].is_file():
        raise ConfigError(f"{table}: map: {same['rig']}: no such file, expected a rig.toml")
    for name in _matching(source, root, table):
        called: str | None = None
        with suppress(DataError):  # the worker that reads it says what is wrong
            called = find_scene_id(source.dataset, root, name)
        asked = Asked(sequence=name, scene=called, root=root, **same)
        try:
            split_scene_id(asked.scene_id)
        except UnknownRecordError as error:
            raise ConfigError(f"{table}: {root}: {error}") from None
        yield asked


def _from(folder: Path, named: str) -> Path:
    """Where a manifest in a folder means a file or a root to be."""
    path = expanded(named) if named.startswith("~") else Path(named)
    return path if is_in_bucket(path) else (folder / path).resolve()


def _streets(source: Source, same: dict[str, Any], table: str) -> Iterator[Asked]:
    known = [camera.name for camera in DEFAULT_CAMERAS]
    if unknown := sorted(set(source.cameras or ()) - set(known)):
        raise ConfigError(
            f"{table}: cameras: no camera {', '.join(unknown)} on the street, "
            f"expected some of {', '.join(known)}"
        )
    seeds = range_of(source.seeds or "")
    if len(seeds) > MAX_SEQUENCES:
        raise ConfigError(f"{table}: seeds: expected at most {MAX_SEQUENCES}, got {len(seeds)}")
    for seed in seeds:
        name = street_id(seed).partition("/")[2]
        yield Asked(sequence=name, seed=seed, width_px=source.width_px, **same)


def _matching(source: Source, root: Path, table: str) -> list[str]:
    """The sequences below a root that a source means, in the order in which it names them."""
    found = find_sequences(source.dataset, root)
    if source.sequences is None:
        return found
    chosen: dict[str, None] = {}
    for pattern in source.sequences:
        is_glob = any(character in pattern for character in _WILD)
        names = [one for one in found if fnmatchcase(one, pattern)] if is_glob else [pattern]
        if not names or not set(names) <= set(found):
            raise ConfigError(
                f"{table}: sequences: {root} has no sequence {pattern!r}, "
                f"it has {len(found)} such as {found[0]}"
            )
        chosen |= dict.fromkeys(names)
    return list(chosen)


def _with_shared_reading(asked: Sequence[Asked]) -> list[Asked]:
    """Let all that mean one scene read it alike, with the cameras of all."""
    by_scene: dict[str, list[Asked]] = {}
    for one in asked:
        by_scene.setdefault(one.scene_id, []).append(one)
    cameras: dict[str, tuple[str, ...] | None] = {}
    for scene_id, same in by_scene.items():
        readings = {(one.root, one.rig, one.sequence, one.frames, one.width_px) for one in same}
        if len(readings) > 1:
            raise ConfigError(
                f"{scene_id} is asked for with different roots, maps, frames or widths; "
                "a store holds one of them"
            )
        choices = [frozenset(one.cameras) if one.cameras else None for one in same]
        if len(set(choices)) < len(choices):
            raise ConfigError(f"{scene_id} is asked for twice with the same cameras")
        sets = [one.cameras for one in same if one.cameras is not None]
        is_all = len(sets) < len(same)
        cameras[scene_id] = None if is_all else tuple(sorted({n for names in sets for n in names}))
    return [one.model_copy(update={"read_cameras": cameras[one.scene_id]}) for one in asked]
