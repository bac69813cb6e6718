"""Bad labels of Waymo, and names that are not there or lead elsewhere, get one clear line."""

import pytest
from waymo_edits import LABELS, joined, split, with_frame
from waymo_records import double, message, text


@pytest.mark.parametrize("name", ["../../x", "/etc/passwd", "", "a b", "x\ny", "\u202e", ".."])
def test_actor_that_is_named_for_a_place(refusal, messages, name):
    line = refusal(with_frame(messages, [(LABELS, 2), 4], lambda _: name.encode()))
    assert "laser_labels[2]" in line
    assert "actor name" in line


def test_actor_whose_name_is_no_text(refusal, messages):
    line = refusal(with_frame(messages, [LABELS, 4], lambda _: b"\xff\xfe\x00"))
    assert "laser_labels[0]" in line


@pytest.mark.parametrize(
    ("field", "number", "complaint"),
    [
        ([1, 1], float("nan"), "box: holds a number that is not finite"),
        ([1, 5], -4.0, "box: the box measures -4 x"),
        ([1, 5], 1e308, "expected positive sizes, 1000 m at most"),
        ([1, 2], 1e12, "box: a box beyond 1000 m"),
        ([3], 9, "label type 9 is not known, expected 0 to 4"),
    ],
)
def test_senseless_label(refusal, messages, field, number, complaint):
    line = refusal(with_frame(messages, [LABELS, *field], lambda _: number))
    assert "laser_labels[0]" in line
    assert complaint in line


def test_label_without_a_box(refusal, messages):
    line = refusal(with_frame(messages, [LABELS, 1], lambda _: None))
    assert "box: the box measures 0 x 0 x 0 m, expected positive sizes" in line


def test_label_that_is_synced_with_no_camera(refusal, messages):
    synced = message(12, double(1, 5.0)) + text(11, "ROOF")
    line = refusal(with_frame(messages, [LABELS], lambda label: label + synced))
    assert "camera_synced_box: sensor 'ROOF' is not known" in line


def test_actor_that_stands_twice_in_a_frame(refusal, messages):
    first = next(field for field in split(messages[1]) if field[0] == LABELS)
    line = refusal([messages[0], messages[1] + joined([first])])
    assert "record 1 at byte" in line
    assert "given twice, expected once a frame" in line
