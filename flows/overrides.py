"""Change single settings of a preset by their dotted path: `fit.steps=500`."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel, TypeAdapter, ValidationError

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
