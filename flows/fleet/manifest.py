"""A fleet's manifest: a TOML file that says which sequences are wanted, and how.

It comes from outside: every key is known or refused, every name stays a name, and a fault is one
line that says the file, the table, the key and what was expected.
"""

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    StrictFloat,
    StrictInt,
    StrictStr,
    ValidationError,
    model_validator,
)

from lidarpainter_models.errors import ConfigError

SYNTHETIC = "synthetic"
MAX_BYTES = 1 << 20
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_GLOB = re.compile(r"[A-Za-z0-9*?\[\]!._-]{1,64}")
_RANGE = re.compile(r"(\d{0,9}):(\d{0,9})")
WORDS = {
    "a valid tuple": "an array",
    "Tuple": "array",
    " after validation": "",
    "valid dictionary or instance of Budget": "table",
    "valid dictionary or instance of Source": "table",
}
"""What TOML calls things that Python calls otherwise."""
_MODEL = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _name(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise ValueError(f"{text!r}: expected a name of letters, digits and ._-")
    return text


def _glob(text: str) -> str:
    if not _GLOB.fullmatch(text) or text.startswith("."):
        raise ValueError(f"{text!r}: expected the name of a sequence, or a glob such as 1*")
    return text


def _range(text: str) -> str:
    match = _RANGE.fullmatch(text)
    if match is None or not match[2] or int(match[1] or 0) >= int(match[2]):
        raise ValueError(f"{text!r}: expected A:B with A < B, such as 0:28")
    return text


def _local(text: str) -> str:
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", text):
        raise ValueError(f"{text!r}: expected a folder; buckets cannot be read yet")
    return text


Name = Annotated[StrictStr, AfterValidator(_name)]
Glob = Annotated[StrictStr, AfterValidator(_glob)]
Range = Annotated[StrictStr, AfterValidator(_range)]
Folder = Annotated[StrictStr, AfterValidator(_local)]
Number = StrictFloat | StrictInt


class Source(BaseModel):
    """Sequences of one dataset, or synthetic streets."""

    model_config = _MODEL

    dataset: Name
    """A dataset, or `synthetic`."""
    root: Folder | None = None
    """Its folder as downloaded; a relative one counts from the manifest."""
    sequences: Annotated[tuple[Glob, ...], Field(min_length=1)] | None = None
    """Names or globs; left out: all."""
    cameras: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    """Cameras to train on; left out: all."""
    frames: Range | None = None
    """`A:B`, B excluded; left out: all, or as many as a street has by default."""
    seeds: Range | None = None
    """Of streets, `A:B`, B excluded."""
    width_px: Annotated[StrictInt, Field(ge=8, le=4096)] | None = None
    """Of the pictures of streets."""
    priority: StrictInt = 0
    """Higher ones go first."""

    @model_validator(mode="after")
    def _fits_dataset(self) -> "Source":
        is_street = self.dataset == SYNTHETIC
        needed, unfit = ("seeds", "root") if is_street else ("root", "seeds")
        others = ("sequences",) if is_street else ("width_px",)
        if getattr(self, needed) is None:
            raise ValueError(f"{needed} is missing, which dataset {self.dataset!r} needs")
        for name in (unfit, *others):
            if getattr(self, name) is not None:
                raise ValueError(f"{name} is not for dataset {self.dataset!r}")
        if is_street and self.frames is not None and range_of(self.frames).start:
            raise ValueError(f"frames {self.frames!r}: a street begins at frame 0")
        return self


class Budget(BaseModel):
    """What a fleet may take."""

    model_config = _MODEL

    hours: Annotated[Number, Field(gt=0)] | None = None
    """Of all workers together; nothing begins after that."""
    hours_per_sequence: Annotated[Number, Field(gt=0)] | None = None
    """An attempt that takes longer is ended, and tried again."""
    memory_gb: Annotated[Number, Field(gt=0)] | None = None
    """Of all workers of one machine together; left out: what the machine has."""
    free_disk_gb: Annotated[Number, Field(ge=0)] = 1.0
    """No work begins that would leave less room on the disk of the store."""


class Manifest(BaseModel):
    """All of a manifest."""

    model_config = _MODEL

    name: Name
    """Of the fleet; a manifest with the same name takes the place of the one before."""
    preset: StrictStr = "preview"
    painter: StrictStr | None = None
    """The preset's if absent."""
    settings: tuple[StrictStr, ...] = Field(default=(), alias="set")
    """`key=value`, as `--set` of `reconstruct`."""
    source: Annotated[tuple[Source, ...], Field(min_length=1)]
    variants: tuple[Name, ...] = ()
    """Names of styles that are wanted of every scene; entered into the catalog."""
    publish: tuple[Literal["scores", "report"], ...] = ("scores", "report")
    """What is made of every fitted scene."""
    budget: Budget = Budget()


def range_of(text: str) -> range:
    """The numbers of a checked `A:B`."""
    start, _, stop = text.partition(":")
    return range(int(start or 0), int(stop))


def read_manifest(path: Path) -> Manifest:
    """Read and check a manifest.

    Raises:
        ConfigError: it cannot be read, or holds something that a manifest does not.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"no manifest {path}: {error.strerror}") from None
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{path}: expected a manifest of at most {MAX_BYTES} bytes")
    try:
        values = tomllib.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # of TOML, of UTF-8, or too deep
        raise ConfigError(f"{path}: expected TOML: {error}") from None
    try:
        return Manifest.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_fault(error, values)}") from None


def _fault(error: ValidationError, values: dict[str, Any]) -> str:
    """The first fault: in which table, at which key, and what was expected."""
    first = error.errors()[0]
    names = [one for one in first["loc"] if not str(one).startswith(("function-", "constrained"))]
    names = [one for one in names if one not in ("float", "int")]  # arms of a number
    table = ""
    owner: type[BaseModel] = Manifest
    if names and names[0] == "source" and len(names) > 1:
        table, owner = f"[[source]] {int(names[1]) + 1}: ", Source  # people count from one
        names = names[2:]
    elif names and names[0] == "budget" and isinstance(values.get("budget"), dict):
        table, owner, names = "[budget]: ", Budget, names[1:]
    key = ".".join(map(str, names))
    if first["type"] == "extra_forbidden":
        known = ", ".join(one.alias or name for name, one in owner.model_fields.items())
        return f"{table}unknown key {key!r}, expected one of {known}"
    if first["type"] == "missing":
        return f"{table}{key} is missing"
    said = first["msg"].removeprefix("Value error, ")
    for python, toml in WORDS.items():
        said = said.replace(python, toml)
    said = said[0].lower() + said[1:]
    given = "" if first["type"] == "value_error" else f", got {_shown(first['input'])}"
    return f"{table}{key}{': ' if key else ''}{said}{given}"


def _shown(value: Any, most: int = 60) -> str:  # noqa: ANN401 - whatever stood there
    text = repr(value)
    return text if len(text) <= most else f"{text[:most]}..."
