"""Vehicles made whole, against shapes and colours that are known."""

import json
import math
from dataclasses import replace

import pytest
import torch
from gaussian_world import FRAME_NS, camera_at, map_points, round_gaussians
from parked_world import clip

from lidarpainter_models.assets.asset_files import ABOUT_FILE, ORIGIN_FILE, read_asset
from lidarpainter_models.assets.completion import completed
from lidarpainter_models.assets.expected_quality import (
    COEFFICIENTS_DB,
    EVIDENCE,
    directions,
    evidence_of,
    expected_psnr_db,
    score_of,
)
from lidarpainter_models.assets.extraction import write_assets
from lidarpainter_models.assets.seen_surfaces import LEAST_WEIGHT, SeenSurface
from lidarpainter_models.assets.sighted_actors import RecordedLook, ShownImage, sighted_actors
from lidarpainter_models.assets.sightings import Look, Sighting
from lidarpainter_models.assets.whole_actors import (
    BEYOND,
    SIGMAS,
    kept_in_box,
    surfaces_of,
    whole_actor,
)
from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.lidar.vehicle_colours import GUESSED, MIRRORED, ORIGINS, SEEN
from lidarpainter_models.lidar.vehicle_shapes import (
    BUNDLED,
    MATERIALS,
    fitted_shape,
    has_known_shape,
)
from lidarpainter_models.scenes.tracks import ActorTrack
from lidarpainter_models.storage.tensor_files import read_tensors

SIZE_M = torch.tensor([4.7, 1.98, 1.45])
RED = torch.tensor([0.6, 0.1, 0.1])
NOTHING = torch.zeros(0, 3)


def model_with(points, gaussians=None):
    own = round_gaussians(torch.zeros(1, 3), RED[None], sigma_m=0.05)
    return ActorModel(
        gaussians=own if gaussians is None else gaussians,
        points=map_points(points, RED.expand_as(points)),
        size_m=SIZE_M,
        category="car",
    )


def seen_where(chosen):
    """A surface without points, red where `chosen` says so of its places, else unseen."""
    surface = SeenSurface.of(model_with(NOTHING))
    rows = chosen(surface)
    surface.weight[rows] = 2 * LEAST_WEIGHT
    surface.rgb_sum[rows] = 2 * LEAST_WEIGHT * RED
    surface.square_sum[rows] = 2 * LEAST_WEIGHT * RED.square().mean()
    return surface


def is_left(surface):
    return surface.normals[:, 1] > 0.3


def test_a_shape_without_points_is_a_car_in_its_box():
    places, normals = fitted_shape(NOTHING, torch.zeros(0), SIZE_M).surface(0.08)
    assert bool((places.abs() <= 1.03 * SIZE_M / 2 + 0.03).all())
    assert torch.allclose(places.amax(0), SIZE_M / 2, atol=0.12)
    assert torch.allclose(normals.norm(dim=1), torch.ones(len(normals)), atol=1e-4)
    outward = (places * normals).sum(1) > 0
    assert float(outward.float().mean()) > 0.9


def test_points_of_one_side_move_the_plane_of_symmetry():
    """The left side and the roof of a vehicle that stands 8 cm to the right of its box."""
    mean = fitted_shape(NOTHING, torch.zeros(0), SIZE_M)
    places, normals = mean.surface(0.1)
    moved = places[(normals[:, 1] > 0.3) | (normals[:, 2] > 0.7)] - torch.tensor([0.0, 0.08, 0.0])
    outliers = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    points = torch.cat([moved, outliers * SIZE_M / 2])
    shape = fitted_shape(points, torch.ones(len(points)), SIZE_M)
    assert float(shape.signed_distance(moved).abs().median()) < 0.03
    assert float(shape.signed_distance(moved).abs().median()) < float(
        mean.signed_distance(moved).abs().median()
    )
    there = shape.mirrored(moved)
    assert torch.allclose(shape.mirrored(there), moved, atol=1e-5)
    assert torch.allclose(shape.signed_distance(there), shape.signed_distance(moved), atol=1e-3)
    assert -0.11 < float(shape.centre_m[1]) < -0.02


def test_the_other_side_is_mirrored_and_the_rest_guessed():
    surface = seen_where(is_left)
    whole = completed(model_with(NOTHING), surface)
    right = surface.normals[:, 1] < -0.35
    assert set(whole.origin[is_left(surface)].tolist()) == {SEEN}
    assert float((whole.origin[right] == MIRRORED).float().mean()) > 0.95
    top = (surface.normals[:, 2] > 0.95) & (surface.places[:, 1].abs() < 0.3)
    assert set(whole.origin[top].tolist()) == {GUESSED}
    assert torch.allclose(whole.model.gaussians.base_rgb[right], RED, atol=0.02)
    paint = top & (surface.shape.materials(surface.places)[:, MATERIALS.index("paint")] > 0.9)
    assert torch.allclose(whole.model.gaussians.base_rgb[paint].mean(0), RED, atol=0.1)
    assert sum(whole.shares.values()) == pytest.approx(1.0)


def test_tyres_that_nobody_saw_are_dark():
    """Only the roof was seen, in red."""
    surface = seen_where(lambda one: one.normals[:, 2] > 0.8)
    whole = completed(model_with(NOTHING), surface)
    tyres = surface.places[:, 2] < -SIZE_M[2] / 2 + 0.06
    assert int(tyres.sum()) > 20
    assert float(whole.model.gaussians.base_rgb[tyres].mean()) < 0.2


def test_an_image_colours_what_faces_it_and_nothing_behind_a_wall():
    surface = SeenSurface.of(model_with(NOTHING))
    camera = camera_at(0.0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([9.0, 0.0, 0.7])
    size = (camera.height_px, camera.width_px)
    shown = {"rgb": RED.expand(*size, 3), "shows_surface": torch.ones(size, dtype=torch.bool)}
    surface.add_look(camera, pose, depth_m=torch.full(size, 3.0), **shown)
    assert surface.seen_share == 0.0
    surface.add_look(camera, pose, depth_m=torch.zeros(size), **shown)
    seen = surface.weight > 0
    assert bool(seen.any())
    assert bool((surface.normals[seen, 0] < 0.3).all())  # the rear faces who drives behind it
    assert torch.allclose(surface.rgb[seen], RED, atol=1e-4)
    assert float(surface.disagreement[seen].max()) < 1e-4


def test_no_gaussian_reaches_out_of_the_box():
    """A spike, one outside, and one that stays as it is."""
    own = round_gaussians(
        torch.tensor([[0.0, 0, 0], [0, 3, 0], [1, 0, 0.1]]), RED.expand(3, 3), sigma_m=0.05
    )
    own.log_scale[0, 0] = math.log(8.0)
    kept = kept_in_box(own, SIZE_M)
    assert len(kept) == 2
    axes = rotation_from_quaternion(kept.rotation_wxyz) * kept.scale_m[:, None]
    reach_m = kept.means.abs() + SIGMAS * axes.norm(dim=2)
    assert bool((reach_m <= BEYOND * SIZE_M / 2 + 1e-4).all())
    assert torch.equal(kept.log_scale[1], own.log_scale[2])


def test_a_vehicle_that_nobody_saw_stays_as_it_was_fitted():
    surface = SeenSurface.of(model_with(NOTHING))
    whole = whole_actor(model_with(NOTHING), surface)
    assert (len(whole.model.gaussians), whole.surface) == (1, None)


def test_a_direction_that_was_seen_is_expected_to_be_better():
    look = Look(
        azimuth_deg=90.0, elevation_deg=8.0, distance_m=8.0, num_pixels=4000, hidden_share=0.0
    )
    sighting = Sighting(looks=[look], pixels_per_m=40.0)
    whole = completed(model_with(NOTHING), seen_where(is_left))
    evidence = evidence_of(whole, sighting)
    assert evidence.shape == (len(directions()), len(EVIDENCE)) == (24, len(COEFFICIENTS_DB))
    seen, mirrored = EVIDENCE.index("seen"), EVIDENCE.index("mirrored")
    assert float(evidence[3, seen]) > 0.7 > 0.3 > float(evidence[9, seen])
    assert float(evidence[9, mirrored]) > 0.7
    assert float(evidence[3, EVIDENCE.index("away")]) == pytest.approx(0, abs=1e-3)
    expected_db = expected_psnr_db(evidence)
    assert float(expected_db[3]) > float(expected_db[9])
    assert 0 <= score_of(expected_db) <= 1
    assert score_of(torch.tensor([99.0])) == 1.0


def test_the_bundled_shapes_are_small():
    assert BUNDLED.stat().st_size < 1_000_000


@pytest.mark.slow
def test_a_parked_car_is_published_whole_with_its_origins(tmp_path):
    """Seen from behind; as its fit is red, so is its front, which nobody saw."""
    source = clip()
    world = source.world
    looks = []
    for frame in range(2):
        camera = camera_at(0.3 * frame)
        drawn = world.fitted.render(camera, frame * FRAME_NS)
        shown = ShownImage(rgb=drawn.rgb.clamp(0, 1), shows_surface=drawn.alpha > 0.5)
        looks.append(
            RecordedLook(
                camera=camera,
                camera_name="front",
                timestamp_ns=frame * FRAME_NS,
                is_seen=True,
                truth_rgb=None,
                shown=lambda shown=shown: shown,
            )
        )
    surfaces = surfaces_of(world)
    sighted_actors(world, looks, lambda _done, _total: None, surfaces)
    records = write_assets(replace(source, surfaces=surfaces), tmp_path)
    (car,) = [one for one in records if one["kind"] == "actor"]
    shares = [car[f"{name}_share"] for name in ORIGINS]
    assert sum(shares) == pytest.approx(1.0)
    assert min(shares[SEEN], shares[GUESSED]) > 0.05
    folder = tmp_path / car["folder"]
    tensors, _ = read_tensors(folder / ORIGIN_FILE)
    gaussians = read_asset(folder).gaussians
    assert len(tensors["origin"]) == car["num_gaussians"] == len(gaussians)
    assert bool((gaussians.means.abs() <= BEYOND * world.parked[0].size_m / 2).all())
    about = json.loads((folder / ABOUT_FILE).read_text())
    assert len(about["expected_psnr_db"]) == len(about["directions_deg"]) == 24
    assert (
        about["score"]
        == car["score"]
        == pytest.approx(score_of(torch.tensor(about["expected_psnr_db"])), abs=1e-5)
    )
    front = gaussians.means[:, 0] > 0.4 * world.parked[0].size_m[0]
    assert set(tensors["origin"][front].tolist()) <= {MIRRORED, GUESSED}
    red, green, _ = gaussians.base_rgb[front].median(0).values.tolist()
    assert red > 1.5 * green


def test_a_box_that_no_vehicle_fills_is_left_alone():
    flat, car = (
        ActorTrack(
            actor_id="one",
            category="car",
            is_moving=False,
            size_m=torch.tensor(size_m),
            frame_indices=torch.zeros(1, dtype=torch.int64),
            timestamps_ns=torch.zeros(1, dtype=torch.int64),
            world_from_box=torch.eye(4, dtype=torch.float64)[None],
            num_points=torch.zeros(1, dtype=torch.int64),
        )
        for size_m in ([4.2, 0.01, 1.5], [4.2, 1.8, 1.5])
    )
    assert not has_known_shape(flat)
    assert has_known_shape(car)
