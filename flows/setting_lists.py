"""Everything that `--set` knows: path, type, default and reason, read from the configurations.

The reason of a setting is the text below its field. Python does not keep that, so it is read from
the source of the class; nothing is imported for it that the parameters do not need themselves.
"""

import ast
import inspect
import json
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from typing import Any, Literal, get_args, get_origin, get_type_hints

from pydantic import BaseModel

from catalog.digests import plain
from flows.overrides import field_names
from lidarpainter_models.errors import ConfigError


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
