"""Why a request is not answered: a code that simulators know, and one line."""

from typing import Literal

from lidarpainter_models.errors import LidarPainterError

Code = Literal[
    "NOT_FOUND",
    "INVALID_ARGUMENT",
    "OUT_OF_RANGE",
    "RESOURCE_EXHAUSTED",
    "FAILED_PRECONDITION",
    "DEADLINE_EXCEEDED",
    "UNAVAILABLE",
    "UNIMPLEMENTED",
]
"""The status codes of gRPC that the server answers with."""


MOST_WORDS = 1000
"""Characters of a refusal: what was sent is quoted in it, and clients take 8 kB of them."""


class RequestError(LidarPainterError, ValueError):
    """A request that is not answered with what it asks for."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message if len(message) <= MOST_WORDS else f"{message[:MOST_WORDS]}...")
        self.code = code


def invalid(message: str) -> RequestError:
    """A field of a request that makes no sense."""
    return RequestError("INVALID_ARGUMENT", message)
