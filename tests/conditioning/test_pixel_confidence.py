import math

import pytest
import torch

from lidarpainter_models.conditioning import pixel_confidence as confidences
from lidarpainter_models.conditioning.pixel_confidence import (
    departure_weight,
    geometric_confidence,
    guidance_gate,
    is_seen,
)
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.protocol import Painting, PaintingConditions

HEIGHT, WIDTH = 40, 60


def camera(x_m=0.0):
    world_from_camera = torch.eye(4, dtype=torch.float64)
    world_from_camera[0, 3] = x_m
    return Camera.centred(world_from_camera, 50.0, width_px=WIDTH, height_px=HEIGHT)


def conditions(**changes):
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    fields = {
        "render_rgb": truth,
        "render_depth_m": torch.full((HEIGHT, WIDTH), 10.0),
        "render_alpha": torch.ones(HEIGHT, WIDTH),
        "lidar_rgb": torch.zeros(HEIGHT, WIDTH, 3),
        "lidar_depth_m": torch.zeros(HEIGHT, WIDTH),
        "lidar_hit": torch.zeros(HEIGHT, WIDTH, dtype=torch.bool),
        "warp_rgb": torch.stack([truth, truth]),
        "warp_valid": torch.ones(2, HEIGHT, WIDTH, dtype=torch.bool),
    }
    return PaintingConditions(**{**fields, **changes})


def painting(rgb):
    return Painting(rgb=rgb, confidence=torch.ones(HEIGHT, WIDTH))


EVERYWHERE = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)


def test_confidence_follows_its_formula(monkeypatch):
    hit = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    hit[10, 10] = True
    given = conditions(lidar_hit=hit, warp_valid=torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool))
    monkeypatch.setattr(confidences, "LIDAR_REACH_RAD", 0.04)  # 2 px
    confidence = geometric_confidence(given, camera(), EVERYWHERE)
    expected = 1 - (1 - 0.6 * math.exp(-3 / 2)) * (1 - 0.3)
    assert confidence[10, 13] == pytest.approx(expected, rel=1e-5)
    assert confidence[10, 10] == pytest.approx(1 - 0.4 * 0.7, rel=1e-5)


def test_a_warped_pixel_is_trusted_more_than_a_bare_render_and_a_hole_not_at_all():
    bare = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    warped = geometric_confidence(conditions(), camera(), EVERYWHERE)
    rendered = geometric_confidence(conditions(warp_valid=bare), camera(), EVERYWHERE)
    hole = geometric_confidence(
        conditions(warp_valid=bare, render_alpha=torch.zeros(HEIGHT, WIDTH)), camera(), EVERYWHERE
    )
    assert (warped > 0.9).all()
    assert torch.allclose(rendered, torch.tensor(0.3))
    assert (hole == 0).all()


def test_two_images_that_agree_count_more_than_one_or_two_that_differ():
    truth = conditions().warp_rgb[0]
    one = torch.stack([EVERYWHERE, ~EVERYWHERE])
    agreeing = geometric_confidence(conditions(), camera(), EVERYWHERE)
    single = geometric_confidence(conditions(warp_valid=one), camera(), EVERYWHERE)
    differing = geometric_confidence(
        conditions(warp_rgb=torch.stack([truth, 1 - truth])), camera(), EVERYWHERE
    )
    assert torch.allclose(agreeing, torch.tensor(1 - 0.1 * 0.7))
    assert torch.allclose(single, torch.tensor(1 - (1 - 0.9 * 0.7) * 0.7))
    assert (differing[2:-2, 2:-2] < single[2:-2, 2:-2]).all()


def test_nothing_outside_every_recorded_image_is_trusted():
    depth_m = torch.full((HEIGHT, WIDTH), 10.0)
    seen = is_seen(camera(2.0), depth_m, [camera(), camera(-1.0)])
    assert seen[:, :50].all()  # 2 m at 10 m and 50 px focal length are 10 px
    assert not seen[:, 50:].any()
    assert (geometric_confidence(conditions(), camera(2.0), seen)[:, 50:] == 0).all()


def test_sky_is_seen_by_its_direction():
    sky = torch.zeros(HEIGHT, WIDTH)
    assert is_seen(camera(30.0), sky, [camera()]).float().mean() > 0.95
    assert not is_seen(camera(), sky, []).any()


def test_the_gate_lets_a_better_painting_pass():
    truth = conditions().warp_rgb[0]
    given = conditions(render_rgb=(truth + 0.2).clamp(0, 1))
    assert torch.equal(guidance_gate(painting(truth), given), torch.ones(HEIGHT, WIDTH))


def test_the_gate_finds_a_hallucinated_block(monkeypatch):
    monkeypatch.setattr(confidences, "GATE_SLACK", 0.1)
    painted = conditions().warp_rgb[0].clone()
    painted[:15, :15] = 1 - painted[:15, :15]
    gate = guidance_gate(painting(painted), conditions())
    assert (gate[3:12, 3:12] < 0.01).all()
    assert (gate[25:, 30:] == 1).all()


def test_the_gate_refuses_a_view_made_worse_everywhere():
    truth = conditions().warp_rgb[0]
    assert (guidance_gate(painting(1 - truth), conditions()) == 0).all()


def test_without_evidence_nothing_is_gated():
    nothing = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    gate = guidance_gate(painting(torch.zeros(HEIGHT, WIDTH, 3)), conditions(warp_valid=nothing))
    assert (gate == 1).all()


def test_a_painting_counts_where_it_departs_from_the_render():
    given = conditions()
    painted = given.render_rgb.clone()
    painted[:, WIDTH // 2 :] += 0.1
    weight = departure_weight(painting(painted), given)
    window = confidences.DEPARTURE_WINDOW_PX
    assert (weight[:, : WIDTH // 2 - window] == 0).all()
    assert (weight[:, WIDTH // 2 + window :] == 1).all()


def test_a_small_departure_counts_in_part():
    low, high = confidences.DEPARTURE_RANGE
    given = conditions()
    weight = departure_weight(painting(given.render_rgb + (low + high) / 2), given)
    assert torch.allclose(weight, torch.tensor(0.5), atol=1e-4)  # roundings of the window's mean
