"""Who drives: the built-in policies by hand-worked cases, and the user's own."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.serving.policies import (
    COMFORT_MPS2,
    STANDING_GAP_M,
    WHEELBASE_M,
    Observation,
    SeenActor,
    changed_lane,
    checked,
    idm_mps2,
    lead_of,
    policy_named,
    pure_pursuit,
)

LINE = np.stack([np.arange(0, 100, 0.5), np.zeros(200)], axis=1)
SEEN = Observation(
    time_s=0.0,
    position_m=(10.0, 0.0),
    yaw_rad=0.0,
    speed_mps=8.0,
    lane_m=LINE,
    recorded_m=LINE,
    recorded_speed_mps=6.0,
    desired_speed_mps=10.0,
)
CAR = SeenActor(
    actor_id="a",
    category="Car",
    position_m=(40.0, 0.5),
    yaw_rad=0.0,
    speed_mps=4.0,
    length_m=4.4,
    width_m=1.8,
)


def test_pure_pursuit_goes_straight_on_its_line_and_back_to_it_beside():
    assert pure_pursuit(SEEN, LINE) == pytest.approx(0.0)
    left = pure_pursuit(replace(SEEN, position_m=(10.0, 1.0)), LINE)
    assert left < 0
    assert pure_pursuit(replace(SEEN, position_m=(10.0, -1.0)), LINE) == pytest.approx(-left)


def test_pure_pursuit_takes_the_curvature_of_a_circle():
    radius = 30.0
    turn = np.linspace(0, np.pi, 2000)
    circle = np.stack([radius * np.sin(turn), radius * (1 - np.cos(turn))], axis=1)
    found = pure_pursuit(replace(SEEN, position_m=(0.0, 0.0)), circle)
    assert found == pytest.approx(math.atan(WHEELBASE_M / radius), rel=0.01)


def test_pure_pursuit_aims_past_the_end_of_its_line():
    assert pure_pursuit(replace(SEEN, position_m=(99.0, 0.0)), LINE) == pytest.approx(0.0)


def test_idm_on_a_free_road_and_in_its_equilibrium():
    assert idm_mps2(0.0, 10.0, math.inf, 0.0) == pytest.approx(COMFORT_MPS2)
    assert idm_mps2(10.0, 10.0, math.inf, 0.0) == pytest.approx(0.0)
    assert idm_mps2(0.0, 10.0, STANDING_GAP_M, 0.0) == pytest.approx(0.0)  # in a queue
    # behind one as fast as we are: (s0 + v T) / sqrt(1 - (v / v0)^4)
    gap_m = (2.0 + 5.0 * 1.5) / math.sqrt(1 - 0.5**4)
    assert idm_mps2(5.0, 10.0, gap_m, 5.0) == pytest.approx(0.0, abs=1e-9)
    assert idm_mps2(8.0, 10.0, 5.0, 0.0) < -8.0


def test_the_lead_is_who_is_next_on_the_line_ahead():
    behind = replace(CAR, actor_id="b", position_m=(2.0, 0.0))
    beside = replace(CAR, actor_id="c", position_m=(20.0, 3.5))
    seen = replace(SEEN, actors=(behind, beside, CAR))
    gap_m, speed_mps = lead_of(seen)
    assert (gap_m, speed_mps) == (pytest.approx(30.0 - 2.2 - 3.8), 4.0)
    assert lead_of(replace(SEEN, actors=(behind, beside))) == (math.inf, 0.0)


def test_a_changed_lane_leaves_its_line_smoothly_for_the_left():
    line = changed_lane(LINE, (10.0, 0.0), 3.5, 20.0)
    np.testing.assert_allclose(line[line[:, 0] <= 10, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(line[line[:, 0] >= 30, 1], 3.5)
    assert line[40 // 1, 1] == pytest.approx(1.75)  # half way, 20 m along
    assert np.abs(np.diff(line[:, 1])).max() < 0.15


def test_policies_of_the_user_are_called_and_their_failures_told(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("def drive(seen):\n    return 0.1 * seen.speed_mps, 0.01\n", "utf-8")
    assert policy_named(str(script))(SEEN) == pytest.approx((0.8, 0.01))
    script.write_text("drive = 3\n", "utf-8")
    with pytest.raises(ConfigError, match="expected a function drive"):
        policy_named(str(script))
    script.write_text("import nothing_of_that_name\n", "utf-8")
    with pytest.raises(ConfigError, match="ModuleNotFoundError"):
        policy_named(str(script))
    with pytest.raises(ConfigError, match=r"expected lane-keep, log, idm or a \.py file"):
        policy_named("fast")


@pytest.mark.parametrize("answer", [None, 1.0, ("a", 0), (math.nan, 0.0), (1.0, 2.0, 3.0)])
def test_answers_that_are_no_two_numbers_are_refused(answer):
    with pytest.raises(ConfigError, match=r"mine at 0\.0 s"):
        checked(lambda _seen: answer, "mine")(SEEN)
