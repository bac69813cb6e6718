"""Painters in training, as a stage sees them: what they stand on, how they learn, what they leave.

The small painter starts from nothing or from weights; the one-step painter stands on a model that
the user brings, or goes on from a weights file that names its model.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from catalog.digests import DIGEST_LENGTH, digest_file
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.held_back import trained_targets
from lidarpainter_models.metrics.lpips import LpipsFiles
from lidarpainter_models.painter import PainterChoice, load_painter
from lidarpainter_models.painter.examples import PairSource
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.nano.training import NanoTrainingConfig, train_nano
from lidarpainter_models.painter.nano.weights import save_weights
from lidarpainter_models.painter.one_step.base_models import open_base
from lidarpainter_models.painter.one_step.loading import SUFFIX, Trainable, split_preset
from lidarpainter_models.painter.one_step.presets import preset_named
from lidarpainter_models.painter.one_step.training import Judges, OneStepTrainingConfig
from lidarpainter_models.painter.one_step.weights import read_trained, save_trained
from lidarpainter_models.painter.training.checkpoints import training_digest
from lidarpainter_models.painter.training.loop import TrainingProgress
from tasks.painter.painters import painter_digest
from tasks.painter.training_processes import Lesson, train_together

NO_FILES = LpipsFiles()
_ORIGIN = ("training_digest", "num_pairs", "steps", "cpu_s", "pairs", "licence", "started_from")
"""What a record keeps of the weights that its training went on from."""

PainterTraining = NanoTrainingConfig | OneStepTrainingConfig


@runtime_checkable
class Student(Protocol):
    """A painter that is to be trained."""

    name: str
    """Of its kind; its files are called so."""

    @property
    def learnt(self) -> frozenset[str]:
        """The targets that its first weights know."""
        ...

    @property
    def inputs(self) -> dict[str, str]:
        """Digests of what it stands on besides the pairs."""
        ...

    @property
    def origin(self) -> dict[str, Any]:
        """What a record says of that; empty where it starts from nothing."""
        ...

    def learn(
        self,
        sources: Sequence[PairSource],
        folder: Path,
        told: Callable[[TrainingProgress], None],
    ) -> dict[str, Any]:
        """Train, with checkpoints in a folder; returns the record."""
        ...

    def licence(self, of_pairs: str) -> str:
        """Terms of the weights, given those of the pairs."""
        ...

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """Write the trained weights."""
        ...


def student_of(
    config: PainterTraining,
    start: str | Path | None,
    lpips: LpipsFiles = NO_FILES,
    num_processes: int = 1,
) -> Student:
    """The painter that a recipe trains; what it needs is checked, and not yet read whole.

    Args:
        config: the recipe.
        start: for the small painter weights to go on from, or None; for the one-step painter its
            model or weights to go on from.
        lpips: weights for the loss of the one-step painter.
        num_processes: in which the one-step painter is trained.

    Raises:
        ConfigError: the one-step painter has no model, its loss lacks what it weighs, several
            processes that cannot train together, or first weights that do not say what they have
            learnt.
        WeightsError: the model or the first weights cannot be used.
    """
    if num_processes < 1 or (num_processes > 1 and config.max_cpu_s is not None):
        raise ConfigError(f"{num_processes} processes cannot share a budget: give --steps")
    if isinstance(config, NanoTrainingConfig):
        if num_processes > 1:
            raise ConfigError("the small painter is trained in one process")
        return NanoStudent(config, None if start is None else first_weights(Path(start)))
    if start is None:
        raise ConfigError("the one-step painter is trained on a model: give --base")
    return OneStepStudent(config, str(start), lpips, num_processes)


def recipe_for(start: str) -> OneStepTrainingConfig:
    """The recipe for a model with a preset after a colon, or for a weights file to go on from.

    Raises:
        WeightsError: it is not there.
    """
    if start.endswith(SUFFIX):
        return OneStepTrainingConfig(network=read_trained(Path(start)).config)
    return OneStepTrainingConfig(network=preset_named(split_preset(start)[1]))


def first_weights(start: Path) -> NanoPainter:
    """The small painter that a training goes on from.

    Raises:
        ConfigError: it learns nothing, or does not say what it has learnt.
        WeightsError: there is no such painter, or its file cannot be used.
    """
    painter = None if PainterChoice.of(start).is_one_step else load_painter(start)
    if not isinstance(painter, NanoPainter) or trained_targets(painter.provenance) is None:
        raise ConfigError(f"{start}: expected a trained painter that says what it has learnt")
    return painter


class NanoStudent:
    """The small painter."""

    name = "nano"

    def __init__(self, config: NanoTrainingConfig, first: NanoPainter | None) -> None:
        self._config = config
        self._first = first
        self._trained = None if first is None else first.network

    @property
    def learnt(self) -> frozenset[str]:
        """See `Student`."""
        known = None if self._first is None else trained_targets(self._first.provenance)
        return known or frozenset()

    @property
    def inputs(self) -> dict[str, str]:
        """See `Student`."""
        if self._first is None:
            return {}
        known = training_digest({}, [], self._first.network.state_dict())
        return {"first weights": known[:DIGEST_LENGTH]}

    @property
    def origin(self) -> dict[str, Any]:
        """See `Student`."""
        return {} if self._first is None else {"started_from": _kept(self._first.provenance)}

    def learn(
        self,
        sources: Sequence[PairSource],
        folder: Path,
        told: Callable[[TrainingProgress], None],
    ) -> dict[str, Any]:
        """See `Student`."""
        start = None if self._first is None else self._first.network
        result = train_nano(
            sources, self._config, start=start, checkpoint_folder=folder, progress=told
        )
        self._trained = result.network
        return result.record

    def licence(self, of_pairs: str) -> str:
        """See `Student`."""
        return of_pairs

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """See `Student`."""
        assert self._trained is not None, "learn before saving"  # noqa: S101
        save_weights(self._trained, path, licence=licence, provenance=provenance)


class OneStepStudent:
    """The one-step painter; its model is read when it learns."""

    name = "one-step"
    _made: Trainable

    def __init__(
        self, config: OneStepTrainingConfig, start: str, lpips: LpipsFiles, num_processes: int
    ) -> None:
        self._config = config
        self._num_processes = num_processes
        self._start = start
        self._files = lpips
        if lpips.missing and lpips != NO_FILES:
            raise ConfigError(lpips.missing)
        if lpips == NO_FILES:
            Judges().check(config.loss)  # before the model is read
        self._goes_on = start.endswith(SUFFIX)
        self._known: dict[str, Any] = {}
        if self._goes_on:
            self._known = read_trained(Path(start)).provenance
            if trained_targets(self._known) is None:
                raise ConfigError(f"{start} does not say what it has learnt")
        else:
            open_base(split_preset(start)[0])

    @property
    def learnt(self) -> frozenset[str]:
        """See `Student`."""
        return trained_targets(self._known) or frozenset()

    @property
    def inputs(self) -> dict[str, str]:
        """See `Student`."""
        files = {"lpips backbone": self._files.backbone, "lpips heads": self._files.heads}
        digests = {
            name: digest_file(path)[:DIGEST_LENGTH]
            for name, path in files.items()
            if path is not None
        }
        return {"model": painter_digest(self._start)} | digests

    @property
    def origin(self) -> dict[str, Any]:
        """See `Student`."""
        found: dict[str, Any] = {"model": self._start, **self.inputs}
        return found | ({"started_from": _kept(self._known)} if self._goes_on else {})

    def learn(
        self,
        sources: Sequence[PairSource],
        folder: Path,
        told: Callable[[TrainingProgress], None],
    ) -> dict[str, Any]:
        """See `Student`; runs on GPUs where there are any."""
        lesson = Lesson(
            start=self._start,
            config=self._config,
            lpips=self._files,
            sources=sources,
            checkpoints=folder,
        )
        self._made, record = train_together(lesson, self._num_processes, told)
        return record | {"base": self._made.base, "base_licence": self._made.licence}

    def licence(self, of_pairs: str) -> str:
        """See `Student`."""
        return f"that of the model underneath ({self._made.licence}), and {of_pairs}"

    def save(self, path: Path, *, licence: str, provenance: dict[str, Any]) -> None:
        """See `Student`."""
        save_trained(
            self._made.network,
            path,
            prompts=self._made.texts,
            base=self._made.base,
            mark=self._made.mark,
            licence=licence,
            provenance=provenance,
        )


def _kept(provenance: Mapping[str, Any]) -> dict[str, Any]:
    return {key: provenance[key] for key in _ORIGIN if key in provenance}
