"""The `lidarpainter` command inside the test's own process: imports are paid once."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cached_property

import cv2

from flows.cli.main import main
from flows.cli.output import set_loudness


@dataclass(frozen=True)
class Answer:
    """How a command ended and what it said."""

    code: int
    out: str
    err: str

    @cached_property
    def json(self):
        """The one object on stdout."""
        return json.loads(self.out)


def call(*words, store=None):
    """Run a command to whatever end."""
    out, err = io.StringIO(), io.StringIO()
    place = [] if store is None else ["--store", str(store.root)]
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([*place, *map(str, words)])
        finally:
            set_loudness("usual")  # of the process, and other tests run in it
    return Answer(code, out.getvalue(), err.getvalue())


def succeed(*words, store=None):
    """Run a command that must end well."""
    answer = call(*words, store=store)
    assert answer.code == 0, answer.err
    return answer


def refuse(*words, store=None):
    """Run a command that must end in one complaint and code 2, nothing else; the complaint."""
    answer = call(*words, store=store)
    assert (answer.code, answer.out) == (2, ""), answer
    (line,) = [line for line in answer.err.splitlines() if line.startswith("lidarpainter: ")]
    assert "unexpected" not in line
    assert "Traceback" not in answer.err
    return line


def complaint(*words, store=None):
    """As `refuse`, of a command that says nothing else at all."""
    answer = call(*words, store=store)
    assert (answer.code, answer.out) == (2, ""), answer
    assert answer.err.startswith("lidarpainter: ")
    assert not answer.err.startswith("lidarpainter: unexpected")
    assert answer.err.count("\n") == 1
    return answer.err


def settings(*assignments):
    """The words of `--set`."""
    return [word for assignment in assignments for word in ("--set", assignment)]


SMALL_TRAINING = settings(
    "training.network.widths=8,8,8",
    "training.network.blocks=1,1,1",
    "training.augmentation.crop_px=32",
    "training.batch_size=2",
    "training.log_every_steps=1",
)
"""Of a small painter that learns in a moment."""


def seen_image(path, width_px, height_px):
    """An image on disk, of the size it should have, that shows something."""
    bgr_u8 = cv2.imread(str(path))
    assert bgr_u8 is not None
    assert bgr_u8.shape == (height_px, width_px, 3)
    assert bgr_u8.std() > 5
    return bgr_u8
