"""Write a finished run as the bundle that driving simulators load."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lidarpainter_models
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.score_tables import least_of
from lidarpainter_models.export.contents import scene_contents
from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.export.simulator_bundle import BundleContents
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.lidar.surroundings import Surroundings, surroundings_of
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.storage.whole_files import whole_file
from tasks.exports.places import STAGE
from tasks.opened import opened
from tasks.progress import listener
from tasks.runs import FinishedRun
from tasks.specs import FittedRef, RunSpec
from tasks.stored import load_observations, load_scene

Envelope = Mapping[str, Any] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivenStreet:
    """A fitted scene, its log where its sweeps say that it was, and what surrounds its path."""

    scene: GaussianScene
    recorded: DrivingScene
    surroundings: Surroundings


def driven_street(run: RunSpec, fitted: FittedRef, envelope: Envelope) -> DrivenStreet:
    """Load what is driven on: for a bundle, and for a drive.

    Raises:
        SceneError: the log has no sweeps that show the ground around its path.
    """
    this = opened(run)
    scene = load_scene(this.store, fitted.gaussians)
    recorded = this.scene.corrected(scene.cameras.path)
    least = least_of(envelope) if envelope else {}
    trusted_m = least.get("left_m") or 0.0, least.get("right_m") or 0.0
    surroundings = surroundings_of(recorded, recorded.swept_frames, trusted_m=trusted_m)
    return DrivenStreet(scene=scene, recorded=recorded, surroundings=surroundings)


def export_bundle(
    run: RunSpec, finished: FinishedRun, envelope: Envelope, row: ExportFormat, out: Path
) -> dict[str, Any]:
    """Write the bundle of a run, and say what is in it.

    Raises:
        ConfigError: the name ends otherwise.
        SceneError: see `driven_street`.
        WriteError: the disk refuses; nothing is left half-written.
    """
    if out.suffix.lower() not in row.endings:
        raise ConfigError(f"{out.name}: expected a name in {', '.join(row.endings)}")
    listener().started(STAGE)
    street = driven_street(run, finished.final, envelope)
    listener().advanced(STAGE, 1, 2, "ground and lanes")
    seen = load_observations(opened(run).store, finished.final.observations)
    times_ns = sorted({one.timestamp_ns for one in street.recorded.views_of(seen.camera_names[0])})
    contents = BundleContents(
        run_id=finished.run_id,
        fitted_on=finished.finished_at.date(),
        software=f"lidarpainter {lidarpainter_models.__version__}",
        scene=street.scene,
        log=opened(run).scene,
        gaussians=scene_contents(street.scene.baked(times_ns[0]), finished.scene_id, times_ns),
        surroundings=street.surroundings,
        envelope=envelope,
        figures=_figures(finished.result),
    )
    with whole_file(out) as aside:
        sizes = row.load_writer()(aside, contents)
    listener().advanced(STAGE, 2, 2, "written")
    road = street.surroundings.road
    return {
        "path": str(out),
        "num_bytes": out.stat().st_size,
        "num_gaussians": contents.gaussians.num_gaussians,
        "num_actors": len(contents.gaussians.actors),
        "lanes": len(road.lanes),
        "lanes_assumed": sum(bool(lane.assumed) for lane in road.lanes),
        "members": ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in sizes.items()),
    }


def _figures(result: Mapping[str, Any]) -> dict[str, float]:
    """What the run was judged by on held-out frames, where it was."""
    recorded = result.get("recorded") or {}
    wanted = {"test_psnr": recorded.get("psnr"), "test_ssim": recorded.get("ssim")}
    return {name: value for name, value in wanted.items() if value is not None}
