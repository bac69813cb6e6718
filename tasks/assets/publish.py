"""Write what a run yields for use elsewhere: actors, street, sky and trajectories, and how well.

One artefact a run, a folder for each asset in it; `sightings.json` lists them as the catalog will.
"""

from collections import Counter
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from catalog.artefacts import Workplace
from lidarpainter_models.assets.extraction import AssetSource, write_assets
from lidarpainter_models.assets.sighted_actors import RecordedLook, ShownImage, sighted_actors
from lidarpainter_models.assets.whole_actors import surfaces_of
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.observations.image_shrinking import fit_camera, shrink_image
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.scenes.records import RecordedView
from tasks.editing.donors import opened_world
from tasks.json_files import write_json
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.runs import FinishedRun
from tasks.specs import RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_scene

KIND = "assets"
SIGHTINGS_FILE = "sightings.json"


@stage_task
def publish_assets(
    run: RunSpec, finished: FinishedRun, observation: ObservationConfig
) -> StageResult:
    """Write the assets of a finished run as an artefact."""
    this = opened(run)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage="publish-assets",
        kind=KIND,
        inputs=this.inputs(finished.final),
        config={"split": run.split, "observation": observation},
        build=partial(_build, this=this, finished=finished, observation=observation),
    )


def _build(
    place: Workplace,
    progress: Progress,
    *,
    this: OpenedRun,
    finished: FinishedRun,
    observation: ObservationConfig,
) -> dict[str, Any]:
    world = opened_world(this.store, finished)
    final = load_scene(this.store, finished.final.gaussians)
    looks = _looks(this, world, observation, final)
    middle_ns = (world.log.start_ns + world.log.end_ns) // 2
    shown = replace(world, scene=final.baked(middle_ns))
    surfaces = surfaces_of(shown)
    sighted = sighted_actors(
        world, looks, lambda done, total: progress(done, total, "seen"), surfaces
    )
    source = AssetSource(
        world=shown,
        sighted=sighted,
        surfaces=surfaces,
        judged_on="held-out" if this.views.test else "training",
        global_from_world=this.scene.global_from_world,
    )
    records = write_assets(source, place.output)
    write_json(place.output / SIGHTINGS_FILE, records)
    return {f"num_{kind}": count for kind, count in Counter(one["kind"] for one in records).items()}


def _looks(
    this: OpenedRun, world: EditedWorld, observation: ObservationConfig, final: GaussianScene
) -> list[RecordedLook]:
    """The images that the fit saw, and those held out; errors are of the latter if there are any.

    A style has no truth: its scene is not judged, and what it shows is rendered.
    """
    scene, is_judged = world.fitted, final.style is None
    looks = [
        RecordedLook(
            camera=scene.refined_camera(view),
            camera_name=view.key[1],
            timestamp_ns=view.timestamp_ns,
            is_seen=True,
            truth_rgb=partial(_seen, view) if is_judged and not this.views.test else None,
            shown=partial(_shown, final, view),
        )
        for view in world.views
    ]
    for held in this.views.test if is_judged else ():
        camera = scene.refined_camera(held, fit_camera(held, observation))
        looks.append(
            RecordedLook(
                camera=camera,
                camera_name=held.camera_name,
                timestamp_ns=held.timestamp_ns,
                is_seen=False,
                truth_rgb=partial(_image, this, held, camera.width_px, camera.height_px),
            )
        )
    return looks


def _shown(final: GaussianScene, view: TrainingView) -> ShownImage:
    """A recorded image in the colours of the scene, or what a style makes of it."""
    if final.style is None:
        rgb = final.exposure.undone(view.rgb, view.key[1], view.timestamp_ns)
    else:
        rgb = final.render(final.refined_camera(view), view.timestamp_ns).rgb.cpu()
    return ShownImage(rgb=rgb.clamp(0, 1), shows_surface=view.shows_surface)


def _seen(view: TrainingView) -> Tensor:
    return view.rgb


def _image(this: OpenedRun, view: RecordedView, width_px: int, height_px: int) -> Tensor:
    image = shrink_image(this.scene.read_image(view), width_px=width_px, height_px=height_px)
    return image.float() / 255
