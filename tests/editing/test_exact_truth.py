"""Edits of a fitted street against the exact truth of the edited street.

`pytest -m slow -s tests/editing/test_exact_truth.py` prints the figures.
"""

import sys
from dataclasses import replace

import pytest
import torch

from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.editing.apply import edited
from lidarpainter_models.editing.filled_scenes import filled
from lidarpainter_models.editing.motions import LogTimes
from lidarpainter_models.editing.script import parse_operations
from lidarpainter_models.editing.worlds import EditedWorld
from lidarpainter_models.gaussians.fitting.config import DensificationConfig, FitConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.painter.selection import load_painter
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.synthetic import SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from lidarpainter_models.synthetic.sequence import record_street
from lidarpainter_models.synthetic.street import SyntheticStreet

SEED, FRONT = 1, "front_camera"
JUDGED = slice(0, None, 3)


@pytest.fixture(scope="module")
def street():
    return SyntheticStreet(
        SyntheticStreetConfig(
            seed=SEED,
            num_frames=14,
            frame_interval_s=0.2,
            width_px=320,
            height_px=180,
            cameras=DEFAULT_CAMERAS[:1],
        )
    )


@pytest.fixture(scope="module")
def world(street, tmp_path_factory):
    """The street, recorded and fitted for half a minute."""
    scene = DrivingScene.open(record_street(street, tmp_path_factory.mktemp("store")))
    seen = prepare_observations(scene, split_views(scene, "all"), ObservationConfig(width_px=320))
    config = FitConfig(
        steps=600,
        log_every=200,
        initialisation=InitialisationConfig(num_gaussians=15_000),
        densification=DensificationConfig(budget=20_000),
    )
    ego = DrivenPath(timestamps_ns=scene.frame_timestamps_ns, world_from_body=scene.world_from_ego)
    fitted = fit_gaussians(seen, config).scene
    return EditedWorld(
        scene=fitted,
        fitted=fitted,
        lidar_map=seen.lidar_map,
        views=seen.views,
        parked=tuple(track for track in scene.tracks if not track.is_moving),
        log=LogTimes(ego=ego),
    )


def figures(street, world, truth, operation, name, came=False):
    """PSNR inside what is uncovered and elsewhere: before, bare, filled."""
    after = edited(world, parse_operations([operation], "test"), {}, {})
    mended = filled(after, ConditionConfig(), load_painter("nano"))
    scenes = {"bare": after.scene, "filled": mended.scene}
    index = [actor.actor_id for actor in street.actors(street.timestamps_ns[0])].index(name)
    sums = {}
    for view in world.views[JUDGED]:
        camera = world.scene.refined_camera(view)
        was, now = (one.render(camera, view.timestamp_ns) for one in (street, truth))
        there = was.actor_index == index
        others = now.actor_index
        moved = torch.zeros_like(there)
        if came:
            ids = [actor.actor_id for actor in truth.actors(view.timestamp_ns)]
            moved = others == ids.index(name)
        inside, elsewhere = there & ~moved, ~there & ~moved
        images = {
            label: one.render(camera, view.timestamp_ns, camera_name=FRONT).rgb.clamp(0, 1)
            for label, one in {"before": world.scene, **scenes}.items()
        }
        for label, image in images.items():
            right = was.rgb if label == "before" else now.rgb
            error = (image - right.float()).square().mean(dim=2)
            for place, mask in (("inside", inside), ("elsewhere", elsewhere), ("moved", moved)):
                entry = sums.setdefault((label, place), [0.0, 0])
                entry[0] += float(error[mask].sum())
                entry[1] += int(mask.sum())
    found = {
        key: float(-10 * torch.tensor(total / count).log10()) if count else None
        for key, (total, count) in sums.items()
    }
    lines = [f"{operation}: {len(mended.confidence)} filled, {mended.num_ground} on the ground"]
    for place in ("inside", "elsewhere", "moved"):
        row = {label: found[label, place] for label in ("before", "bare", "filled")}
        shown = (f"{label} {value:.2f}" for label, value in row.items() if value is not None)
        lines.append(f"  {place:9} PSNR {', '.join(shown)}")
    sys.stdout.write("\n" + "\n".join(lines) + "\n")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["car-000", "parked-027"])
def test_what_a_removed_actor_uncovers_is_filled(street, world, name):
    truth = street.changed(
        lambda actors: tuple(actor for actor in actors if actor.actor_id != name)
    )
    found = figures(street, world, truth, {"op": "remove", "actors": [name]}, name)
    assert found["filled", "inside"] > found["bare", "inside"] + 1.5
    assert abs(found["filled", "elsewhere"] - found["bare", "elsewhere"]) < 0.1


@pytest.mark.slow
def test_a_moved_actor_leaves_a_road_behind(street, world):
    def aside(actors):
        return tuple(
            replace(actor, d_m=actor.d_m + 1.0) if actor.actor_id == "parked-027" else actor
            for actor in actors
        )

    operation = {"op": "move", "actor": "parked-027", "trajectory": "lateral:1"}
    found = figures(street, world, street.changed(aside), operation, "parked-027", came=True)
    assert found["filled", "inside"] > found["bare", "inside"] + 1.5
    assert abs(found["filled", "elsewhere"] - found["bare", "elsewhere"]) < 0.1
