"""Mixes of styles are read, written and refused in one line."""

import pytest

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.weather.mix import StyleMix


@pytest.mark.parametrize("text", ["foggy:1", "foggy:0.5+night:0..1", "rain:0.25+night:1..0.5"])
def test_a_mix_is_written_as_it_is_read(text):
    assert StyleMix.parse(text).text == text


def test_strength_follows_the_time_of_the_log_and_multiplies_all():
    mix = StyleMix.parse("night:0..1+rain", strength=0.5)
    assert mix.strengths(0.0) == {"rain": 0.5}
    assert mix.strengths(0.5) == {"night": 0.25, "rain": 0.5}
    assert mix.strengths(7.0) == {"night": 0.5, "rain": 0.5}  # after the log as at its end
    assert StyleMix.parse("clear").strengths(0.3) == {}


@pytest.mark.parametrize(
    ("text", "options", "complaint"),
    [
        ("snow", {}, "no style 'snow'"),
        ("foggy:1.5", {}, "strength of foggy must be from 0 to 1"),
        ("night:0..2", {}, "strength of night must be from 0 to 1"),
        ("foggy:-1", {}, "expected NAME"),
        ("foggy++night", {}, "expected NAME"),
        ("foggy:0.1..", {}, "expected NAME"),
        ("rain+rain", {}, "names a style twice"),
        ("night", {"strength": 1.1}, "strength must be from 0 to 1"),
        ("night", {"strength": float("nan")}, "strength must be from 0 to 1"),
        ("foggy", {"visibility_m": 0.0}, "visibility must be above 0"),
        ("foggy", {"visibility_m": float("nan")}, "visibility must be above 0"),
        ("night", {"visibility_m": 80.0}, "visibility needs fog"),
    ],
)
def test_what_is_no_mix_is_refused_in_one_line(text, options, complaint):
    with pytest.raises(ConfigError, match=complaint) as refusal:
        StyleMix.parse(text, **options)
    assert "\n" not in str(refusal.value)
