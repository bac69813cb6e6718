"""Edit scripts are read word by word, and refused in one line that says where."""

import json

import pytest

from lidarpainter_models.editing.script import parse_script
from lidarpainter_models.errors import ConfigError

SCRIPT = [
    {"op": "remove", "actors": ["a", "b"]},
    {"op": "move", "actor": "c", "trajectory": "lane-change:3.5@2s+3s"},
    {"op": "re-route", "actor": "c", "trajectory": "follow:d+along:-5"},
    {"op": "insert", "name": "new", "source": {"ply": "car.ply"}, "speed_mps": 0},
    {"op": "swap", "actor": "d", "source": {"run": "latest", "actor": "e", "store": "other"}},
    {"op": "scale", "actor": "d", "factor": 1.1},
    {"op": "retime", "actor": "d", "delay_s": -1, "speed": 0.5},
    {"op": "stop", "actor": "d", "at_s": 1},
    {"op": "freeze", "at_s": 2.5},
    {"op": "crop", "from_m": 0, "to_m": 20},
    {"op": "drive", "trajectory": "lateral:3"},
    {"op": "style", "prompt": "foggy:0.5+night:0..1", "visibility_m": 80},
]


def test_a_script_says_again_what_was_read():
    operations = parse_script(json.dumps(SCRIPT), "script s")
    assert [one.op for one in operations] == [step["op"] for step in SCRIPT]
    said = json.dumps([one.model_dump(exclude_defaults=True) for one in operations])
    assert parse_script(said, "script s") == operations


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "is no JSON list"),
        ("{}", "expected a JSON list"),
        ("[]", "at least one operation"),
        ("[" * 5000, "is no JSON list"),
        ('[{"op": "fly"}]', "operation 1: Input tag 'fly'"),
        ('[{"actor": "a"}]', "operation 1"),
        ("[3]", "operation 1"),
        ('[{"op": "freeze", "at_s": 1}, {"op": "freeze"}]', "operation 2, at_s: Field required"),
        ('[{"op": "freeze", "at_s": NaN}]', "NaN is no number"),
        ('[{"op": "freeze", "at_s": 1e999}]', "operation 1, at_s: Input should be"),
        ('[{"op": "freeze", "at_s": "1"}]', "at_s: Input should be a valid number"),
        ('[{"op": "freeze", "at_s": 1, "over": 2}]', "over: Extra inputs are not permitted"),
        ('[{"op": "remove", "actors": []}]', "operation 1, actors"),
        ('[{"op": "crop", "from_m": 3, "to_m": 3}]', "expected from_m < to_m"),
        ('[{"op": "swap", "actor": "a", "source": {}}]', "expected one of actor, asset and ply"),
        ('[{"op": "swap", "actor": "a", "source": {"asset": "b", "run": "c"}}]', "has no run"),
        (
            '[{"op": "move", "actor": "a", "trajectory": "latral:2"}]',
            "operation 1.*'latral:2': expected one of",
        ),
        ('[{"op": "drive", "trajectory": "lateral:9"}]', "at most 8 metres"),
        ('[{"op": "style", "prompt": "snow"}]', "no style 'snow'"),
    ],
)
def test_what_is_no_script_is_refused(text, complaint):
    with pytest.raises(ConfigError, match=rf"script s.*{complaint}") as caught:
        parse_script(text, "script s")
    assert "\n" not in str(caught.value)
