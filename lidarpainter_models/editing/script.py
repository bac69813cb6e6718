"""The words of an edit script: a JSON list of operations, each with its fields.

What is not said here is refused, so that a script that is read can be replayed. Times are seconds
since the log began, lengths metres.
"""

import json
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.gaussians.model.styling.scene_style import LampState
from lidarpainter_models.geometry.shifts import MAX_SHIFT_M
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.weather.mix import StyleMix

MOST_OPERATIONS = 10_000
ASSET = "asset:"
Name = Annotated[str, Field(min_length=1, max_length=200)]
Words = TypeVar("Words")
_Seconds = Annotated[float, Field(ge=0, le=1e6)]
_Metres = Annotated[float, Field(ge=-1e4, le=1e4)]


def _leads_somewhere(spec: str, *, max_shift_m: float | None = None) -> str:
    parse_trajectory(spec, max_shift_m=max_shift_m)
    return spec


_Way = Annotated[Name, AfterValidator(_leads_somewhere)]


class OperationWords(BaseModel):
    """Fields of an operation: what is unknown, of another type or no number is refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class ActorSource(OperationWords):
    """Whose Gaussians are put in: those of a run, of the library of assets, or of a file.

    The text `asset:ID` is short for one of the library.
    """

    actor: Name | None = None
    run: Name | None = None
    """The run of that actor; the run that is edited if absent."""
    asset: Name | None = None
    """Id of an asset, or a unique prefix of one."""
    store: Name | None = None
    """Folder of the store of that run or asset; this one if absent."""
    ply: Name | None = None
    """Gaussians of one car: x ahead, y left, z up; its box is found around them."""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:  # noqa: ANN401 - whatever stood there
        is_short = isinstance(value, str) and value.startswith(ASSET)
        return {"asset": value.removeprefix(ASSET)} if is_short else value

    @model_validator(mode="after")
    def _is_one_of_them(self) -> "ActorSource":
        if sum(one is not None for one in (self.actor, self.ply, self.asset)) != 1:
            raise ValueError("expected one of actor, asset and ply")
        if self.ply is not None and (self.run or self.store):
            raise ValueError("a ply has no run and no store")
        if self.asset is not None and self.run:
            raise ValueError("an asset has no run")
        return self


class Remove(OperationWords):
    """Take actors out."""

    op: Literal["remove"]
    actors: Annotated[tuple[Name, ...], Field(min_length=1, strict=False)]


class Move(OperationWords):
    """Let an actor go elsewhere; `re-route` is another word for it."""

    op: Literal["move", "re-route"]
    actor: Name
    trajectory: _Way
    """Off its own path: see `geometry/trajectory_specs.py`."""


class Insert(OperationWords):
    """Put an actor in, before the ego or in another one's place."""

    op: Literal["insert"]
    source: ActorSource
    name: Name
    """What it is called from then on."""
    ahead_m: _Metres = 15.0
    """How far ahead of the ego's place when the log begins, along its path."""
    left_m: _Metres = 0.0
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Against the road."""
    speed_mps: Annotated[float, Field(ge=-100, le=100)] | None = None
    """Along the ego's path; None drives as the ego does."""
    trajectory: _Way = "recorded"
    """Off the path that these give."""


class Swap(OperationWords):
    """Put another actor in the place of one, on its path."""

    op: Literal["swap"]
    actor: Name
    source: ActorSource


class Scale(OperationWords):
    """Make an actor larger or smaller where it stands."""

    op: Literal["scale"]
    actor: Name
    factor: Annotated[float, Field(gt=0.05, lt=20)]


class Retime(OperationWords):
    """Let an actor drive its path later, faster or slower."""

    op: Literal["retime"]
    actor: Name
    delay_s: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    speed: Annotated[float, Field(gt=0.01, lt=100)] = 1.0
    """Times its own."""


class Stop(OperationWords):
    """Let an actor brake and stand from then on."""

    op: Literal["stop"]
    actor: Name
    at_s: _Seconds
    """When it begins to brake."""
    over_s: Annotated[float, Field(ge=0, le=1000)] = 1.0


class Freeze(OperationWords):
    """Let everybody stand as they do at a time."""

    op: Literal["freeze"]
    at_s: _Seconds


class Lamps(OperationWords):
    """Switch an actor's lamps at night, and let it brake; of a parked car they are off before."""

    op: Literal["lamps"]
    actor: Name
    state: LampState
    from_s: _Seconds = 0.0
    until_s: _Seconds | None = None
    """The end of the log if absent."""


class Crop(OperationWords):
    """Keep a stretch of road only, counted along the ego's path."""

    op: Literal["crop"]
    from_m: _Metres
    to_m: _Metres

    @model_validator(mode="after")
    def _holds_something(self) -> "Crop":
        if self.from_m >= self.to_m:
            raise ValueError("expected from_m < to_m")
        return self


class Join(OperationWords):
    """Take from another run of the same place what it saw better."""

    op: Literal["join"]
    run: Name
    """Fitted to the same sequence, or to one whose frame of reference is known to be the same."""
    store: Name | None = None
    """Folder of its store; this one if absent."""


class Drive(OperationWords):
    """Where the camera goes when the edited run is shown with the script; changes no scene."""

    op: Literal["drive"]
    trajectory: Annotated[Name, AfterValidator(partial(_leads_somewhere, max_shift_m=MAX_SHIFT_M))]


class Style(OperationWords):
    """Put the edited scene into fog, night or rain; the last one holds."""

    op: Literal["style"]
    prompt: Name
    """Such as `foggy:0.5+night`: see `weather/mix.py`."""
    strength: Annotated[float, Field(ge=0, le=1)] = 1.0
    visibility_m: Annotated[float, Field(gt=0, le=1e5)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0

    @property
    def mix(self) -> StyleMix:
        """The styles."""
        return StyleMix.parse(self.prompt, strength=self.strength, visibility_m=self.visibility_m)

    @model_validator(mode="after")
    def _is_known(self) -> "Style":
        _ = self.mix
        return self


Operation = Annotated[
    Remove
    | Move
    | Insert
    | Swap
    | Scale
    | Retime
    | Stop
    | Lamps
    | Freeze
    | Crop
    | Join
    | Drive
    | Style,
    Field(discriminator="op"),
]
_SCRIPT: TypeAdapter[tuple[Operation, ...]] = TypeAdapter(
    Annotated[tuple[Operation, ...], Field(strict=False, max_length=MOST_OPERATIONS)]
)


def parse_operations(found: Any, where: str) -> tuple[Operation, ...]:  # noqa: ANN401 - any JSON
    """Read a list of operations.

    Raises:
        ConfigError: it is no such list; the message says which operation, which field, and why.
    """
    operations = parsed(_SCRIPT.validate_python, found, where)
    if not operations:
        raise ConfigError(f"{where}: expected at least one operation")
    return operations


def parse_script(text: str, where: str) -> tuple[Operation, ...]:
    """Read a script: a JSON list of operations.

    Raises:
        ConfigError: it is no JSON, or no such list.
    """
    try:
        found = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where} is no JSON list of operations: {error}") from None
    if not isinstance(found, list):
        raise ConfigError(f"{where}: expected a JSON list of operations")
    return parse_operations(found, where)


def parsed(parse: Callable[[Any], Words], found: Any, where: str) -> Words:  # noqa: ANN401
    """What pydantic makes of a list of operations, or of an object that holds one.

    Raises:
        ConfigError: it refuses it; the message says which operation, which field, and why.
    """
    try:
        return parse(found)
    except ValidationError as error:
        first = error.errors()[0]
        place = [*first["loc"]]
        if len(place) > 1 and isinstance(place[1], int):
            del place[0]  # the name of the list
        step = ""
        if place and isinstance(number := place[0], int):
            step = f" operation {number + 1}"
            del place[0]
        field = ".".join(str(part) for part in place[1:] or place)  # but for the operation's name
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigError(f"{where}{step}{f', {field}' if field else ''}: {message}") from None


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")
