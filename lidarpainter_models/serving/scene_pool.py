"""Scenes that a server offers: loaded when first asked for, let go by least use."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from threading import Lock

from lidarpainter_models.serving.messages import TimedRequest
from lidarpainter_models.serving.refusals import RequestError
from lidarpainter_models.serving.renderer import ServedScene
from lidarpainter_models.serving.scene_edits import SceneEdits

MOST_TOLD = 20
"""Names in a line about a scene that is not there."""


@dataclass(frozen=True)
class LoadedScene:
    """A scene in memory."""

    edits: SceneEdits
    num_bytes: int
    """About what it takes."""


@dataclass(eq=False, kw_only=True)
class ScenePool:
    """The scenes by the names that clients know."""

    runs: Mapping[str, str]
    """What each name stands for; several may stand for the same."""
    announced: tuple[str, ...]
    """The names that clients are told."""
    load: Callable[[str], LoadedScene]
    """Gives what one of `runs` stands for."""
    most_bytes: int
    _loaded: OrderedDict[str, LoadedScene] = field(default_factory=OrderedDict, init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    def get(self, name: str, request: TimedRequest | None = None) -> ServedScene:
        """The scene of a name as its clients have it, with who else is in a request.

        Raises:
            RequestError: NOT_FOUND; what `SceneEdits.shown` refuses.
        """
        return self.edits_of(name).shown(request)

    def edits_of(self, name: str) -> SceneEdits:
        """What is changed in the scene of a name; others make room where memory is short.

        One that was changed stays until it is restored.

        Raises:
            RequestError: NOT_FOUND.
        """
        if name not in self.runs:
            known = ", ".join(self.announced[:MOST_TOLD])
            more = ", ..." if len(self.announced) > MOST_TOLD else ""
            raise RequestError("NOT_FOUND", f"no scene {name!r} here, expected {known}{more}")
        run = self.runs[name]
        with self._lock:
            if run not in self._loaded:
                self._loaded[run] = self.load(run)
            self._loaded.move_to_end(run)
            for other in [*self._loaded][:-1]:
                num_bytes = sum(each.num_bytes for each in self._loaded.values())
                if num_bytes > self.most_bytes and not self._loaded[other].edits.is_edited:
                    del self._loaded[other]
            return self._loaded[run].edits

    def loaded(self) -> tuple[str, ...]:
        """Names of the scenes in memory, as clients are told them."""
        runs = tuple(self._loaded)
        return tuple(name for name in self.announced if self.runs[name] in runs)

    def num_changes(self) -> int:
        """How often a scene in memory was changed: what was asked before is another question."""
        return sum(each.edits.num_changes for each in tuple(self._loaded.values()))
