"""A run opened once: its scene, split, painter and device, shared by all its stages.

Tasks pass a `RunSpec`, which is a few words, never tensors; `opened` turns it into an `OpenedRun`
that all stages of one process share. So a scene is opened once and a painter loaded once, however
many stages ask; `tasks.stored` does the same for artefacts.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import torch

from catalog.errors import UnknownRecordError
from catalog.store import Store, open_store
from lidarpainter_models.devices import chosen_device
from lidarpainter_models.errors import SceneError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.kernels.backends import check_choice
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.painter.selection import PainterChoice
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.schema import GLOBAL_FRAME, MANIFEST_NAME
from lidarpainter_models.scenes.splits import ViewSplit, split_views
from lidarpainter_models.scenes.stored import Fetch
from tasks.specs import FittedRef, RunSpec, SplitSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenedRun:
    """What a run works on, ready to be used; read when first asked for and kept."""

    spec: RunSpec
    store: Store
    scene: DrivingScene
    views: ViewSplit
    device: torch.device

    @cached_property
    def painter(self) -> PainterChoice:
        """Who paints; loaded at its first painting."""
        return PainterChoice.of(self.spec.painter)

    def inputs(self, fitted: FittedRef, *, paints: bool = False) -> dict[str, str]:
        """Digests of what a stage reads of a fitted scene, by the part each plays."""
        digests = {
            "scene": self.scene.content_digest,
            "observations": fitted.observations.digest,
            "gaussians": fitted.gaussians.digest,
        }
        return digests | ({"painter": self.painter.digest} if paints else {})

    def held_out(self, observation: ObservationConfig, *, or_train: bool = False) -> HeldOut:
        """The views that no fit saw; with `or_train` those it saw, where it saw all."""
        views = self.views.test or (self.views.train if or_train else ())
        return HeldOut(scene=self.scene, test_views=views, observation=observation)


def opened(spec: RunSpec) -> OpenedRun:
    """The run of a spec, opened once in a process as long as its scene stays as it is.

    Raises:
        SceneError: the scene is not there, is not complete, has no poses, or lacks a camera.
        ConfigError: the split leaves nothing to train on, or the device is not there.
    """
    return _opened(spec, open_posed(open_store(spec.store_path), spec.split.scene_id))


def open_posed(store: Store, scene_id: str) -> DrivingScene:
    """A scene of the store of which it is known where the car drove.

    Raises:
        SceneError: it is not there, not complete, or has no poses.
    """
    scene = open_scene(store, scene_id)
    if not scene.has_poses:
        raise SceneError(
            f"scene {scene_id} has no poses, expected to know where the car drove: "
            f"`lidarpainter localise {scene_id}` finds it"
        )
    return scene


def open_scene(store: Store, scene_id: str) -> DrivingScene:
    """A scene of the store, opened once in a process as long as it stays as it is.

    Raises:
        SceneError: it is not there, or not complete.
    """
    folder = store.scene_folder(scene_id)
    try:
        files = store.scene_files(scene_id)
        if files is not None:
            files([MANIFEST_NAME])
        manifest = (folder / MANIFEST_NAME).stat()
    except (FileNotFoundError, NotADirectoryError, UnknownRecordError):
        known = store.scene_ids()
        raise SceneError(
            f"no scene {scene_id} in {store.name}: ingest it first "
            f"(there {'is' if len(known) == 1 else 'are'} {', '.join(known) or 'none'})"
        ) from None
    return _scene(folder, files, manifest.st_ino, manifest.st_mtime_ns)


def global_frame_of(scene: DrivingScene) -> str:
    """Name of a scene's global frame: that of its own sequence, unless its manifest names one.

    Scenes of one name have one global frame.
    """
    return str(scene.manifest.get(GLOBAL_FRAME) or f"{scene.dataset}/{scene.sequence}")


def open_split(store: Store, split: SplitSpec) -> tuple[DrivingScene, ViewSplit]:
    """A scene and its views on both sides of the split."""
    scene = open_scene(store, split.scene_id)
    return scene, split_views(scene, split.spec, split.cameras)


def forget_opened() -> None:
    """Let go of the scenes and the run that this process has opened."""
    _opened.cache_clear()
    _scene.cache_clear()


@lru_cache(maxsize=4)
def _scene(folder: Path, files: Fetch | None, _inode: int, _changed_ns: int) -> DrivingScene:
    return DrivingScene.open(folder, files)


@lru_cache(maxsize=1)
def _opened(spec: RunSpec, scene: DrivingScene) -> OpenedRun:
    device = chosen_device(spec.device)
    check_choice(spec.kernels)
    if device.type == "cuda":
        torch.cuda.set_device(device)  # kernels are launched on the current one
    return OpenedRun(
        spec=spec,
        store=open_store(spec.store_path),
        scene=scene,
        views=split_views(scene, spec.split.spec, spec.split.cameras),
        device=device,
    )
