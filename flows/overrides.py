"""Change single settings of a preset by their dotted path: `fit.steps=500`."""

import ast
import inspect
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pydantic import BaseModel, TypeAdapter, ValidationError

from catalog.digests import plain
from lidarpainter_models.errors import ConfigError

Parameters = TypeVar("Parameters", bound=BaseModel)


def with_overrides(parameters: Parameters, assignments: Sequence[str]) -> Parameters:
    """The same parameters with some settings changed, each checked against its type.

    An assignment is `path=value`; the value is JSON, or plain text, or values with commas between
    for a sequence.

    Raises:
        ConfigError: no such setting, or a value that does not fit it.
    """
    for assignment in assignments:
        path, separator, text = assignment.partition("=")
        if not separator or not path:
            raise ConfigError(f"{assignment!r}: expected a setting as key=value")
        parameters = _assigned(parameters, path.strip().split("."), text.strip(), path)
    return parameters


def with_changes(parameters: Parameters, changes: Mapping[str, Any]) -> Parameters:
    """The same parameters with whole fields replaced, checked as at the first time.

    Raises:
        ConfigError: a value does not fit its field.
    """
    values = {field: getattr(parameters, field) for field in type(parameters).model_fields}
    return checked(type(parameters), {**values, **changes})


def checked(model: type[Parameters], values: Mapping[str, Any]) -> Parameters:
    """A model of values from outside.

    Raises:
        ConfigError: a value does not fit its field.
    """
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _assigned(owner: Any, names: list[str], text: str, path: str) -> Any:  # noqa: ANN401
    """A copy of a model or dataclass with one setting below it changed."""
    known = field_names(owner)
    name = names[0]
    if name not in known:
        place = path.split(".")[: -len(names)]
        raise ConfigError(
            f"no setting {path!r}: {'.'.join(place) or 'the parameters'} "
            f"{'has' if place else 'have'} {', '.join(known) or 'nothing to set'}"
        )
    if len(names) > 1:
        value = _assigned(getattr(owner, name), names[1:], text, path)
    else:
        value = _parsed(get_type_hints(type(owner))[name], text, path)
    is_model = isinstance(owner, BaseModel)
    return with_changes(owner, {name: value}) if is_model else replace(owner, **{name: value})


def field_names(owner: Any) -> list[str]:  # noqa: ANN401 - a model, a dataclass or a plain value
    """What can be set of a model or a dataclass; nothing of a plain value."""
    if isinstance(owner, BaseModel):
        return list(type(owner).model_fields)
    if is_dataclass(owner):
        return [field.name for field in fields(owner) if field.init]
    return []


def _parsed(expected: Any, text: str, path: str) -> Any:  # noqa: ANN401 - any type of a setting
    adapter = TypeAdapter(expected)
    complaint = ""
    for candidate in _readings(text):
        try:
            return adapter.validate_python(candidate)
        except ValidationError as error:
            complaint = complaint or error.errors()[0]["msg"]
    raise ConfigError(f"{path}={text}: {complaint}")


def _readings(text: str) -> list[Any]:
    """What a text may mean, the likeliest first."""
    readings: list[Any] = []
    for source in (text, f"[{text}]"):
        try:
            readings.append(json.loads(source))
        except ValueError:
            continue
    if text.lower() in ("none", "null"):
        readings.append(None)
    return [*readings, text, [part.strip() for part in text.split(",")]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One value that can be set."""

    path: str
    """With dots between, as `--set` takes it."""
    type: str
    default: Any
    """The default value, as JSON types."""
    reason: str


def known_settings(parameters: BaseModel, prefix: str = "") -> list[Setting]:
    """The settings of some parameters whose path is the prefix or lies below it.

    Raises:
        ConfigError: none does.
    """
    every = list(_settings(parameters, ""))
    found = [one for one in every if one.path == prefix or one.path.startswith(f"{prefix}.")]
    found = found if prefix else every
    if not found:
        groups = dict.fromkeys(one.path.partition(".")[0] for one in every)
        raise ConfigError(f"no setting {prefix!r}, expected one of {', '.join(groups)}")
    return found


def _settings(owner: Any, place: str) -> Iterator[Setting]:  # noqa: ANN401 - model or dataclass
    types, described = get_type_hints(type(owner)), _described(type(owner))
    for name in field_names(owner):
        value, (annotation, reason) = getattr(owner, name), described.get(name, ("", ""))
        if isinstance(value, BaseModel) or is_dataclass(value):
            yield from _settings(value, f"{place}{name}.")
            continue
        hint = types[name]
        shown = "|".join(map(str, get_args(hint))) if get_origin(hint) is Literal else annotation
        default = json.loads(json.dumps(plain(value)))
        yield Setting(path=f"{place}{name}", type=shown, default=default, reason=reason)


def _described(owner: type) -> dict[str, tuple[str, str]]:
    """Type as written and the text below, by field, of a class and what it inherits."""
    found: dict[str, tuple[str, str]] = {}
    for one in reversed(owner.__mro__):
        if one in (object, BaseModel):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(one))).body[0]
        statements = body.body if isinstance(body, ast.ClassDef) else []
        for field, below in zip(statements, [*statements[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                found[field.target.id] = (ast.unparse(field.annotation), _text(below))
    return found


def _text(statement: ast.stmt | None) -> str:
    """What a bare string says, on one line."""
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return " ".join(str(statement.value.value).split())
    return ""
