"""Signals that change and cars that brake: the lamps of a street, and nothing else of it."""

import copy
import dataclasses
import json

import numpy as np
import pytest
import torch

from lidarpainter_models.synthetic import RigCamera, SyntheticStreet, SyntheticStreetConfig
from lidarpainter_models.synthetic.plan.car_kinds import SHAPES
from lidarpainter_models.synthetic.street import START_NS
from lidarpainter_models.synthetic.textures.cars import add_car_surfaces
from lidarpainter_models.synthetic.textures.surfaces import SurfaceSet
from lidarpainter_models.synthetic.world.car_shapes import build_car
from lidarpainter_models.synthetic.world.lamps import (
    PROUD_M,
    RIM_M,
    Switching,
    SwitchingLamps,
    with_brake_lenses,
)

READOUT_S = 0.03
CAMERA = RigCamera(name="front_camera", focal_per_width=3.0, readout_s=READOUT_S)
"""A long lens: signals are 60 m away."""
PLAIN = SyntheticStreetConfig(
    seed=7, num_frames=4, width_px=192, height_px=108, cameras=(CAMERA,), samples_per_axis=1
)
CONFIG = dataclasses.replace(PLAIN, are_lamps_switching=True)
NUM_SURFACES, NUM_PRIMITIVES, NUM_TEXELS = 516, 144_843, 42_181_698
"""Of the street of this seed before it had lamps that switch."""
RED, GREEN = 0, 1


@pytest.fixture(scope="module")
def street():
    return SyntheticStreet(CONFIG)


@pytest.fixture(scope="module")
def plain():
    return SyntheticStreet(PLAIN)


def front(street, time_s):
    timestamp_ns = START_NS + round(time_s * 1e9)
    return street.camera("front_camera", timestamp_ns), timestamp_ns


def with_all(street, value):
    """The street with every lamp on (1) or off (0), at any time."""
    other = copy.copy(street)

    def instances(time_s):
        moments = street._instances(time_s)
        return moments._replace(is_lit=np.full_like(moments.is_lit, value))

    other._instances = instances
    return other


def lenses_in(street, camera, timestamp_ns, margin_px=1.0):
    """Pixels (lenses height width) that show each lens, or would if nothing hid it."""
    boxes = [state.world_from_box for state in street.actors(timestamp_ns)]
    signs = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    masks = []
    for lamp in street.lamps(timestamp_ns):
        corners = lamp.centre_m + signs * lamp.size_m / 2
        if lamp.actor_index >= 0:
            pose = boxes[lamp.actor_index]
            corners = corners @ pose[:3, :3].T + pose[:3, 3]
        pixels_uv, depth_m = camera.project(corners)
        mask = torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
        if float(depth_m.min()) > 0:
            low = (pixels_uv.amin(0) - margin_px).floor().long().clamp(min=0)
            high = (pixels_uv.amax(0) + margin_px).ceil().long().clamp(min=0)
            mask[low[1] : high[1], low[0] : high[0]] = True
        masks.append(mask)
    return torch.stack(masks)


def lead_lamp(street):
    """The lens index and the course of the brakes of the next car in the ego lane."""
    actors = street._city.actors
    ahead = [
        (actor.start_s_m, index)
        for index, actor in enumerate(actors)
        if actor.lenses and abs(actor.d_m) < 1
    ]
    index = min(ahead)[1]
    states = street.lamps(START_NS)
    place = next(i for i, state in enumerate(states) if state.actor_index == index)
    return place, street._city.lamps.switchings[actors[index].lenses[0].lamp]


def test_a_street_whose_lamps_stay_is_what_it_was(plain):
    arrays = plain._city.arrays
    assert arrays.surface_value.shape[0] == NUM_SURFACES
    assert arrays.prim_index.shape[0] == NUM_PRIMITIVES
    assert arrays.texels.shape[0] == NUM_TEXELS
    assert plain.lamps(START_NS) == []
    assert plain._instances(np.zeros(3)).is_lit.shape == (3, 0)
    assert (arrays.surface_index[:, 4] == -1).all()


def test_settings_with_and_without_lamps_survive_a_manifest():
    assert SyntheticStreetConfig.from_dict(json.loads(json.dumps(CONFIG.to_dict()))) == CONFIG
    earlier = PLAIN.to_dict()
    del earlier["are_lamps_switching"]
    assert SyntheticStreetConfig.from_dict(earlier) == PLAIN


def test_all_but_the_lenses_is_the_street_without_them(street, plain):
    assert np.array_equal(street._city.arrays.texels, plain._city.arrays.texels)
    assert np.array_equal(street._city.arrays.light, plain._city.arrays.light)
    camera, timestamp_ns = front(plain, 0.3)
    pairs = zip(street.actors(timestamp_ns), plain.actors(timestamp_ns), strict=True)
    for state, before in pairs:
        assert (state.actor_id, state.size_m) == (before.actor_id, before.size_m)
        assert torch.equal(state.world_from_box, before.world_from_box)
    images = [shown.render(camera, timestamp_ns) for shown in (street, plain)]
    is_elsewhere = ~lenses_in(street, camera, timestamp_ns, margin_px=4).any(0)
    assert float(is_elsewhere.float().mean()) > 0.8
    assert torch.equal(images[0].rgb[is_elsewhere], images[1].rgb[is_elsewhere])
    assert torch.equal(images[0].depth_m[is_elsewhere], images[1].depth_m[is_elsewhere])


def test_lit_lenses_are_brighter_in_their_colour_and_light_nothing_else(street):
    camera, timestamp_ns = front(street, 0.2)
    lit, dark = (with_all(street, value).render(camera, timestamp_ns) for value in (1, 0))
    brighter = lit.rgb - dark.rgb
    masks = lenses_in(street, camera, timestamp_ns)
    assert (brighter[~masks.any(0)] == 0).all()
    assert torch.equal(lit.depth_m, dark.depth_m)
    colours = [RED if lens.lamp == 0 else GREEN for lens in street._city.lamps.standing]
    seen = {RED: 0, GREEN: 0, "brake": 0}
    for index, mask in enumerate(masks):
        is_changed = mask & (brighter != 0).any(-1)
        if not is_changed.any():
            continue
        change = brighter[is_changed]
        colour = colours[index] if index < len(colours) else RED
        assert (change >= 0).all()
        assert float(change[:, colour].mean()) > 0.25
        assert (change[:, colour] > 1.3 * change[:, 1 - colour]).all()
        seen[colour if index < len(colours) else "brake"] += int(is_changed.sum())
    assert min(seen.values()) >= 4
    assert seen["brake"] >= 40


def test_an_image_shows_the_lamps_as_told_for_its_time(street):
    place, braking = lead_lamp(street)
    reds = {}
    for time_s in (braking.times_s[0] - 1e-3, braking.times_s[0] + 1e-3):
        camera, timestamp_ns = front(street, time_s)
        mask = lenses_in(street, camera, timestamp_ns, margin_px=-2)[place]
        is_lit = street.lamps(timestamp_ns)[place].is_lit
        reds[is_lit] = street.render(camera, timestamp_ns).rgb[mask].mean(0)
    assert float(reds[True][RED]) > float(reds[False][RED]) + 0.3
    assert float(reds[False][RED]) > 2 * float(reds[False][GREEN])  # dark red


def test_each_row_is_read_with_the_lamps_of_its_time(street):
    place, braking = lead_lamp(street)
    camera, timestamp_ns = front(street, braking.times_s[0])
    rows, columns = torch.nonzero(
        lenses_in(street, camera, timestamp_ns, margin_px=-1)[place], as_tuple=True
    )
    row, column = int(rows.float().mean()), int(columns.float().mean())
    height = camera.height_px
    _, timestamp_ns = front(street, braking.times_s[0] - (row / height - 0.5) * READOUT_S)
    read, dark, lit = (
        seen.render_recorded("front_camera", timestamp_ns).rgb[:, column - 3 : column + 4]
        for seen in (street, with_all(street, 0), with_all(street, 1))
    )
    first, last = int(rows.min()), int(rows.max())
    assert first < row < last
    assert torch.equal(read[first:row], dark[first:row])
    assert torch.equal(read[row : last + 1], lit[row : last + 1])
    assert (lit[first : last + 1, :, RED] > dark[first : last + 1, :, RED] + 0.3).all()


def test_signals_change_once_and_show_one_colour(street):
    states = [street.lamps(START_NS + time_ms * 1_000_000) for time_ms in range(0, 2500, 100)]
    num_signals = len(street._city.lamps.standing)
    assert num_signals == 10
    assert all(state.actor_index == -1 for state in states[0][:num_signals])
    courses = np.array([[state.is_lit for state in now[:num_signals]] for now in states])
    assert (courses[:, 0::2] != courses[:, 1::2]).all()
    assert (courses[:, 0::2] == courses[:, :1]).all()
    (change,) = np.flatnonzero(np.diff(courses[:, 0])) + 1
    assert 6 <= change <= 14
    assert street._city.lamps.switchings[0].times_s[0] <= 0.1 * change


def test_every_moving_car_has_two_lenses_and_nobody_else_has_any(street):
    counts = np.bincount([s.actor_index + 1 for s in street.lamps(START_NS)], minlength=300)[1:]
    for index, state in enumerate(street.actors(START_NS)):
        has_brakes = state.is_moving and state.category != "pedestrian"
        assert counts[index] == (2 if has_brakes else 0)


def drawn_lamps(seed):
    return SwitchingLamps(*map(np.random.default_rng, np.random.SeedSequence(seed).spawn(2)))


def test_cars_brake_once_or_twice_with_pauses():
    lamps = drawn_lamps(3)
    for _ in range(200):
        times_s = np.array(lamps.switchings[lamps.add_brakes()].times_s)
        assert times_s.size in (2, 4)
        steps_s = np.diff(times_s)
        assert times_s[0] >= 0.4
        assert times_s[0] < 1.6
        assert ((steps_s[0::2] >= 0.6) & (steps_s[0::2] <= 1.2)).all()
        assert (steps_s[1::2] >= 0.4).all()
        assert times_s[1] <= 2.1
    assert {len(switching.times_s) for switching in lamps.switchings} == {2, 4}
    assert not any(switching.is_lit_first for switching in lamps.switchings)


def test_signals_of_other_streets_change_at_other_times_and_both_ways():
    drawn = [drawn_lamps(seed) for seed in range(20)]
    for lamps in drawn:
        assert lamps.add_signals() == {"red": 0, "green": 1}
    first = [lamps.switchings[1] for lamps in drawn]
    assert {switching.is_lit_first for switching in first} == {True, False}
    assert len({switching.times_s for switching in first}) == 20
    assert all(0.6 <= switching.times_s[0] <= 1.4 for switching in first)


def test_a_lamp_is_on_from_one_switch_to_the_next():
    switching = Switching(False, (0.5, 1.5))
    times_s = np.array([-1.0, 0.499, 0.5, 1.499, 1.5, 9.0])
    assert switching.is_lit(times_s).tolist() == [False, False, True, True, False, False]
    assert Switching(True, (0.5,)).is_lit(times_s[:3]).tolist() == [True, True, False]
    assert SwitchingLamps().is_lit(times_s).shape == (6, 0)


@pytest.mark.parametrize("kind", SHAPES)
def test_lenses_lie_on_the_rear_of_every_kind_of_car(kind):
    surfaces = SurfaceSet()
    shape = SHAPES[kind]
    mesh, size = build_car(shape, add_car_surfaces(surfaces, shape, np.random.default_rng(0)))
    braking, (left, right) = with_brake_lenses(mesh, size, shape, surfaces, 4)
    surface = len(surfaces.surfaces) - 1
    assert (surfaces.surfaces[surface].lamp, left.lamp, right.lamp) == (4, 4, 4)
    corners = braking.corners()[braking.surface == surface]
    assert (np.abs(corners) <= size / 2).all()  # the box stays as tight as it was
    mirrored_m = left.centre_m * [1, -1, 1]
    assert mirrored_m == pytest.approx(right.centre_m, abs=1e-3)  # the body's triangles are not
    assert left.centre_m[1] > 0.4
    assert left.centre_m[0] < -size[0] / 2 + 0.15
    assert left.size_m[1:] == pytest.approx([0.2, 0.14])
    assert PROUD_M + RIM_M < left.size_m[0] + PROUD_M < 0.15  # curved with the bodywork


@pytest.mark.slow
def test_an_edited_street_keeps_the_lamps_of_those_who_stay(street):
    edited = street.changed(lambda actors: actors[1:])
    before = [state for state in street.lamps(START_NS) if state.actor_index != 0]
    after = edited.lamps(START_NS)
    assert len(after) == len(before) == len(street.lamps(START_NS)) - 2
    for kept, state in zip(before, after, strict=True):
        assert state.actor_index == (kept.actor_index - 1 if kept.actor_index >= 0 else -1)
        assert torch.equal(state.centre_m, kept.centre_m)
        assert state.is_lit == kept.is_lit
    place, braking = lead_lamp(edited)
    assert edited.lamps(START_NS + round((braking.times_s[0] + 0.01) * 1e9))[place].is_lit


def test_the_truth_of_a_lamp_says_where_it_is(street):
    state = street.lamps(START_NS)[0]
    assert state.centre_m.shape == state.size_m.shape == (3,)
    assert 2 < float(state.centre_m[2]) < 7  # a signal, in the world
