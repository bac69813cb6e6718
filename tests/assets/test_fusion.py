"""Vehicles fused from several sightings, against a shape and colours that are known."""

import math

import pytest
import torch
from sighted_cars import front, rear, sighting, true_rgb

from lidarpainter_models.assets.expected_quality import evidence_of, expected_psnr_db
from lidarpainter_models.assets.fusion import compared, fused_vehicle
from lidarpainter_models.assets.sighted_vehicles import read_sighted, write_sighted
from lidarpainter_models.errors import DataError
from lidarpainter_models.lidar.vehicle_colours import SEEN
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors

SHIFT_M = (0.08, -0.05, 0.0)
"""Where the second box stands in the first one."""


def both_ends(**second):
    sightings = [sighting(front), sighting(rear, azimuth_deg=180.0, **second)]
    seen, whole = zip(*sightings, strict=True)
    return seen, whole


def fused_of(seen, whole, gains=None):
    models = [one.model for one in whole]
    given = torch.ones(len(seen), 3) if gains is None else torch.tensor(gains)
    return fused_vehicle(seen, models, given)


def error_of(whole, shift_m=(0.0, 0.0, 0.0)):
    """RMS of its colours against the true car."""
    there = whole.surface.places + torch.tensor(shift_m)
    return float((whole.model.gaussians.base_rgb - true_rgb(there)).square().mean().sqrt())


def test_a_fused_car_is_better_than_either_sighting():
    seen, whole = both_ends(shift_m=SHIFT_M)
    fused = fused_of(seen, whole)
    assert fused.taken == (0, 1)
    alone = [error_of(whole[0]), error_of(whole[1], SHIFT_M)]
    assert error_of(fused.whole) < 0.7 * min(alone)
    seen_share = [float((one.origin == SEEN).float().mean()) for one in (*whole, fused.whole)]
    assert seen_share[2] > max(seen_share[:2]) + 0.05
    assert {look.azimuth_deg for look in fused.sighting.looks} == {0.0, 180.0}


def test_the_light_of_two_runs_is_compared_where_both_show_the_same():
    seen, whole = both_ends(gain=(0.5, 0.6, 0.8))
    itself, other = compared(seen, whole[0].model)
    assert itself.log_ratio == (0.0, 0.0, 0.0)
    assert other.num_places > 300
    assert other.log_ratio == pytest.approx([-math.log(one) for one in (0.5, 0.6, 0.8)], abs=0.03)


def test_with_its_gain_removed_a_darker_sighting_does_no_harm():
    seen, whole = both_ends(gain=(0.5, 0.6, 0.8))
    mended = fused_of(seen, whole, [[1.0, 1.0, 1.0], [1 / 0.5, 1 / 0.6, 1 / 0.8]])
    plain = fused_of(*both_ends())
    assert error_of(mended.whole) == pytest.approx(error_of(plain.whole), abs=0.005)


def test_a_car_of_another_colour_in_the_same_place_is_left_out():
    def blue(places):
        return true_rgb(places).flip(1) * 0.5 + torch.tensor([0.0, 0.1, 0.5])

    seen, whole = both_ends(paint=blue)
    assert fused_of(seen, whole) is None
    third, again = sighting(rear, azimuth_deg=180.0)
    fused = fused_of((*seen, third), (*whole, again))
    assert fused.taken == (0, 2)


def test_what_is_kept_of_a_sighting_is_small_and_read_again(tmp_path):
    kept, _ = sighting(front)
    path = tmp_path / "sighted.safetensors"
    write_sighted(path, kept)
    assert path.stat().st_size < 150_000
    again = read_sighted(path)
    assert again.sighting.looks == kept.sighting.looks
    for name in ("places", "normals", "rgb"):
        assert torch.allclose(getattr(again, name), getattr(kept, name), atol=0.006)
    assert torch.allclose(again.weight, kept.weight, rtol=0.01)
    assert torch.allclose(again.measured.points_box, kept.measured.points_box, atol=0.003)
    tensors, header = read_tensors(path)
    for name, spoilt in (("normals", torch.zeros(3)), ("rgb", tensors["rgb"][:5]), ("cells", None)):
        others = {key: value for key, value in tensors.items() if key != name}
        write_tensors(path, others if spoilt is None else others | {name: spoilt}, header)
        with pytest.raises(DataError, match=name):
            read_sighted(path)
    path.write_bytes(b"{}")
    with pytest.raises(DataError, match="sighted"):
        read_sighted(path)


def test_more_looks_are_worth_more_whatever_parts_they_show():
    seen, whole = both_ends()
    fused = fused_of(seen, whole)
    alone = evidence_of(whole[0], seen[0].sighting)
    together = evidence_of(fused.whole, fused.sighting, alone)
    assert torch.equal(together[:, -2:], alone[:, -2:])
    assert float(expected_psnr_db(together).mean()) > float(expected_psnr_db(alone).mean())
