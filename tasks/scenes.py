"""Scenes of the store, and which of their views may be seen."""

from dataclasses import dataclass

from catalog.store import Store
from lidarpainter_models.errors import SceneError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import ViewSplit, split_views


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitSpec:
    """Which views of a scene may be seen."""

    scene_id: str
    spec: str = "alternate"
    """`alternate`, `forward:17:8` or `all`; see `lidarpainter_models.scenes.splits`."""
    cameras: tuple[str, ...] | None = None
    """Cameras to train on and to judge; None takes all."""


def open_scene(store: Store, scene_id: str) -> DrivingScene:
    """A scene of the store.

    Raises:
        SceneError: it is not there, or not complete.
    """
    folder = store.scene_folder(scene_id)
    if not folder.exists():
        known = sorted(
            f"{path.parent.name}/{path.name}" for path in store.root.glob("scenes/*/[!.]*")
        )
        raise SceneError(
            f"no scene {scene_id} in {store.root}: ingest it first "
            f"(there {'is' if len(known) == 1 else 'are'} {', '.join(known) or 'none'})"
        )
    return DrivingScene.open(folder)


def open_split(store: Store, split: SplitSpec) -> tuple[DrivingScene, ViewSplit]:
    """A scene and its views on both sides of the split."""
    scene = open_scene(store, split.scene_id)
    return scene, split_views(scene, split.spec, split.cameras)
