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

SYNTHETIC, STORED, BAG = "synthetic", "stored", "mcap"
"""In place of a dataset: streets to be drawn, and scenes that are in the store; bags, which alone
have a map."""
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
    "valid dictionary or instance of Configuration": "table",
}
"""What TOML calls things that Python calls otherwise."""
_SPECIAL_KEYS = {"root", "seeds", "scenes", "sequences", "frames", "width_px", "map"}
_KEYS: dict[str, tuple[str, set[str]]] = {
    SYNTHETIC: ("seeds", {"frames", "width_px"}),
    STORED: ("scenes", set()),
    BAG: ("root", {"sequences", "frames", "map"}),
}
"""What a source that is unlike other datasets needs, and what else it may have of these."""
Publication = Literal["scores", "examination", "report", "assets"]
_MODEL = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _name(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise ValueError(f"{text!r}: expected a name of letters, digits and ._-")
    return text


def _glob(text: str) -> str:
    if not _GLOB.fullmatch(text) or text.startswith("."):
        raise ValueError(f"{text!r}: expected the name of a sequence, or a glob such as 1*")
    return text


def _scene(text: str) -> str:
    if [_GLOB.fullmatch(part) is None for part in text.split("/")] != [False, False]:
        raise ValueError(f"{text!r}: expected dataset/sequence")
    return text


def _range(text: str) -> str:
    match = _RANGE.fullmatch(text)
    if match is None or not match[2] or int(match[1] or 0) >= int(match[2]):
        raise ValueError(f"{text!r}: expected A:B with A < B, such as 0:28")
    return text


def _root(text: str) -> str:
    if re.match(r"(?!s3:)[A-Za-z][A-Za-z0-9+.-]*://", text):
        raise ValueError(f"{text!r}: expected a folder or s3://BUCKET/PREFIX")
    return text


Name = Annotated[StrictStr, AfterValidator(_name)]
Glob = Annotated[StrictStr, AfterValidator(_glob)]
SceneName = Annotated[StrictStr, AfterValidator(_scene)]
Range = Annotated[StrictStr, AfterValidator(_range)]
Root = Annotated[StrictStr, AfterValidator(_root)]
Number = StrictFloat | StrictInt


class Source(BaseModel):
    """Sequences of one dataset, or synthetic streets."""

    model_config = _MODEL

    dataset: Name
    """A dataset, `synthetic`, or `stored`."""
    root: Root | None = None
    """Folder or address of the dataset, as downloaded; a relative one counts from the manifest."""
    map: StrictStr | None = None
    """Of bags: the rig.toml that says which topic is which sensor; as proposed where it is left
    out; a relative one counts from the manifest."""
    sequences: Annotated[tuple[Glob, ...], Field(min_length=1)] | None = None
    """Names or globs; left out: all."""
    scenes: Annotated[tuple[SceneName, ...], Field(min_length=1)] | None = None
    """`dataset/sequence` of scenes that are in the store."""
    cameras: Annotated[tuple[Name, ...], Field(min_length=1)] | None = None
    """Cameras to train on; left out: all."""
    frames: Range | None = None
    """`A:B`, B excluded; left out: all, or as many as a street has by default."""
    seeds: Range | None = None
    """Seeds of streets, `A:B`, B excluded."""
    width_px: Annotated[StrictInt, Field(ge=8, le=4096)] | None = None
    """Width of the pictures of streets."""
    priority: StrictInt = 0
    """Higher ones go first."""

    @model_validator(mode="after")
    def _fits_dataset(self) -> "Source":
        needed, allowed = _KEYS.get(self.dataset, ("root", {"sequences", "frames"}))
        if getattr(self, needed) is None:
            raise ValueError(f"{needed} is missing, which dataset {self.dataset!r} needs")
        for name in sorted(_SPECIAL_KEYS - {needed} - allowed):
            if getattr(self, name) is not None:
                raise ValueError(f"{name} is not for dataset {self.dataset!r}")
        if self.seeds is not None and self.frames is not None and range_of(self.frames).start:
            raise ValueError(f"frames {self.frames!r}: a street begins at frame 0")
        return self


class Configuration(BaseModel):
    """One way to make the sequences, where several are to be compared."""

    model_config = _MODEL

    name: Name
    preset: StrictStr | None = None
    """The manifest's if absent, as the painter."""
    painter: StrictStr | None = None
    settings: tuple[StrictStr, ...] = Field(default=(), alias="set")
    """`key=value`, after those of the manifest."""


class Budget(BaseModel):
    """What a fleet may take."""

    model_config = _MODEL

    hours: Annotated[Number, Field(gt=0)] | None = None
    """Hours of all workers together; nothing begins after that."""
    money_per_hour: Annotated[Number, Field(ge=0)] | None = None
    """Price of one worker's hour, in whatever currency, for `fleet report` and `catalog cost`."""
    hours_per_sequence: Annotated[Number, Field(gt=0)] | None = None
    """An attempt that takes longer is ended, and tried again."""
    memory_gb: Annotated[Number, Field(gt=0)] | None = None
    """Memory of all workers of one machine together; left out: what the machine has."""
    free_disk_gb: Annotated[Number, Field(ge=0)] = 1.0
    """No work begins that would leave less room on the disk of the store."""


class Manifest(BaseModel):
    """All of a manifest."""

    model_config = _MODEL

    name: Name
    """Name of the fleet; a manifest with the same name takes the place of the one before."""
    preset: StrictStr = "preview"
    painter: StrictStr | None = None
    """The preset's if absent."""
    settings: tuple[StrictStr, ...] = Field(default=(), alias="set")
    """`key=value`, as `--set` of `reconstruct`."""
    source: Annotated[tuple[Source, ...], Field(min_length=1)]
    configuration: tuple[Configuration, ...] = ()
    """Every sequence is made in each of these ways; left out: in one."""
    fit_seeds: Annotated[tuple[Annotated[StrictInt, Field(ge=0)], ...], Field(min_length=1)] = (0,)
    """Each way is tried with each of these, which decide in which order a fit sees its views."""
    variants: tuple[Name, ...] = ()
    """Names of styles; of every scene a run in each of them is made too."""
    publish: tuple[Publication, ...] = ("scores", "report")
    """What is made of every fitted scene; assets of its variants too."""
    budget: Budget = Budget()

    @model_validator(mode="after")
    def _tells_ways_apart(self) -> "Manifest":
        names = [way.name for way in self.configuration]
        if len(set(names)) < len(names) or len(set(self.fit_seeds)) < len(self.fit_seeds):
            raise ValueError("two configurations have one name, or two fit_seeds are equal")
        return self


LISTS: dict[str, type[BaseModel]] = {"source": Source, "configuration": Configuration}
"""Tables that a manifest may hold several of."""


def range_of(text: str) -> range:
    """The numbers of a checked `A:B`."""
    start, _, stop = text.partition(":")
    return range(int(start or 0), int(stop))


def read_manifest(path: Path) -> Manifest:
    """Read and check a manifest.

    Raises:
        ConfigError: it cannot be read, or holds something that a manifest does not.
    """
    values = read_toml(path)
    try:
        return Manifest.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_fault(error, values)}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The values of a TOML file from outside.

    Raises:
        ConfigError: it cannot be read, is too large, or is no TOML in UTF-8.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"no manifest {path}: {error.strerror}") from None
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{path}: expected a manifest of at most {MAX_BYTES} bytes")
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: expected TOML in UTF-8: save it in that encoding") from None
    except (ValueError, RecursionError) as error:  # of TOML, or too deep
        raise ConfigError(f"{path}: expected TOML: {error}") from None


def _fault(error: ValidationError, values: dict[str, Any]) -> str:
    """The first fault: in which table, at which key, and what was expected."""
    first = error.errors()[0]
    names = [one for one in first["loc"] if not str(one).startswith(("function-", "constrained"))]
    names = [one for one in names if one not in ("float", "int")]  # arms of a number
    table = ""
    owner: type[BaseModel] = Manifest
    if names and names[0] in LISTS and len(names) > 1:
        # people count from one
        table, owner = f"[[{names[0]}]] {int(names[1]) + 1}: ", LISTS[str(names[0])]
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
