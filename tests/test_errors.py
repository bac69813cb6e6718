"""Errors are one line, whatever they quote."""

import pytest

from lidarpainter_models.errors import BackendError, DataError, MissingPackageError, WriteError


@pytest.mark.parametrize("kind", [DataError, BackendError, MissingPackageError, WriteError])
def test_an_error_is_one_line_that_no_terminal_obeys(kind):
    assert str(kind("token a\nb\x1b[2J\u2028\ud800: Grüße")) == (
        "token a\\nb\\x1b[2J\\u2028\\ud800: Grüße"
    )


def test_a_system_error_keeps_its_own_words():
    assert str(WriteError(28, "No space left on device")) == "[Errno 28] No space left on device"
