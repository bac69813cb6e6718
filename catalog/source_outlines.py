"""Outlines of modules: which symbols a source file defines, what each is, and what each names.

A symbol is a function, a class or a constant at the top of a module. Its digest covers its syntax
tree, without positions, comments and docstrings, and what its imported names stand for. Fields
that are empty are left out of the tree, so Python 3.11 to 3.13 agree. Statements that are none of
these (a loop that registers things) run when the module is imported and together make up the
symbol `RUNNING`.

What a symbol names is written `name` or `name.attribute` for a name of its module, and
`module:name` for what is imported inside a function; `module:` is a module as a whole. A `*` in a
module stands for what an `import_module(f"...")` fills in.
"""

import ast
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any, NamedTuple

from catalog.digests import canonical_json, digest_text
from catalog.errors import IdentityError

RUNNING = ""
PARSE_ATTEMPTS = 5
_NO_PART = {"ctx", "kind", "type_comment"}
_IMPORTS = (ast.Import, ast.ImportFrom)
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


class Symbol(NamedTuple):
    """One symbol of a module."""

    digest: str
    names: list[str]
    """What it reaches by name, among what its module defines or imports."""


@dataclass(frozen=True)
class Outline:
    """What a module defines and imports."""

    symbols: dict[str, Symbol]
    imports: dict[str, list[str]]
    """Where each imported name comes from, `module:name` or `module:`."""


def outline_of(module: str, path: Path) -> Outline:
    """The outline of a source file, kept beside its bytecode until the file changes.

    Raises:
        IdentityError: the file cannot be read, or is no Python.
    """
    try:
        source = path.read_bytes()
        key = hashlib.sha256(b"\0".join([source, module.encode(), _own_source()])).hexdigest()
        kept = Path(cache_from_source(path)).with_suffix(".outline.json")
        return _kept_outline(kept, key) or _keep(kept, key, _outline(module, path, source))
    except (OSError, SyntaxError) as error:
        raise IdentityError(f"the code in {path} has no digest: {error}") from None


def _kept_outline(path: Path, key: str) -> Outline | None:
    with suppress(OSError, ValueError):
        content = json.loads(path.read_bytes())
        if content["key"] == key:
            symbols = {name: Symbol(*symbol) for name, symbol in content["symbols"].items()}
            return Outline(symbols, content["imports"])
    return None


def _keep(path: Path, key: str, outline: Outline) -> Outline:
    content = {"key": key, "symbols": outline.symbols, "imports": outline.imports}
    aside = path.with_suffix(f".{os.getpid()}")
    with suppress(OSError):  # a folder that cannot be written costs time, nothing else
        path.parent.mkdir(exist_ok=True)
        aside.write_text(json.dumps(content), "utf-8")
        aside.replace(path)
    return outline


@cache
def _own_source() -> bytes:
    return Path(__file__).read_bytes()


def _outline(module: str, path: Path, source: bytes) -> Outline:
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    parts: dict[str, list[ast.stmt]] = defaultdict(list)
    imports: dict[str, set[str]] = defaultdict(set)
    uses: dict[str, set[str]] = defaultdict(set)
    for statement in _parsed(source, path).body:
        names = _defined(statement)
        for name in _registers_at(statement):
            uses[name].update(names)
        for node in () if names else ast.walk(statement):
            for name, target in _imported(node, package):
                imports[name].add(target)
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                parts.setdefault(node.id, [])
        if not isinstance(statement, _IMPORTS) and not _is_prose(statement):
            for name in names or [RUNNING]:
                parts[name].append(statement)
                uses[name] |= _free(statement, package)
    origins = {name: sorted(found) for name, found in imports.items()}
    return Outline(_symbols(parts, uses, origins), origins)


def _parsed(source: bytes, path: Path) -> ast.Module:
    """Python 3.11 counts the depth of all threads as one: where two parse at once, one fails."""
    for _ in range(PARSE_ATTEMPTS - 1):
        with suppress(SystemError):  # CPython issue 106905
            return ast.parse(source, path)
    return ast.parse(source, path)


def _symbols(
    parts: dict[str, list[ast.stmt]], uses: dict[str, set[str]], origins: dict[str, list[str]]
) -> dict[str, Symbol]:
    defined = {*parts, *origins}
    symbols = {}
    for name, statements in parts.items():
        known = [use for use in sorted(uses[name]) if ":" in use or _head(use) in defined]
        content = [repr(_tree(statements)), [[use, origins.get(_head(use))] for use in known]]
        symbols[name] = Symbol(digest_text(canonical_json(content)), known)
    return symbols


def _defined(statement: ast.stmt) -> list[str]:
    """Names of the symbols that a statement at the top of a module defines."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return [statement.name]
    targets: list[ast.expr] = []
    if isinstance(statement, ast.AnnAssign):
        targets = [statement.target]
    elif isinstance(statement, ast.Assign):
        for target in statement.targets:
            targets += target.elts if isinstance(target, ast.Tuple) else [target]
    names = [target.id for target in targets if isinstance(target, ast.Name)]
    return names if len(names) == len(targets) else []


def _registers_at(statement: ast.stmt) -> Iterator[str]:
    """Symbols that a definition is handed to: `@register(symbol)` and `@symbol.register`."""
    for decorator in getattr(statement, "decorator_list", ()):
        if isinstance(decorator, ast.Call):
            yield from (one.id for one in decorator.args if isinstance(one, ast.Name))
            decorator = decorator.func
        if isinstance(decorator, ast.Attribute) and isinstance(decorator.value, ast.Name):
            yield decorator.value.id


def _imported(node: ast.AST, package: str) -> Iterator[tuple[str, str]]:
    """Names that an import binds, and where they come from."""
    if isinstance(node, ast.Import):
        for alias in node.names:
            bound = alias.asname or _head(alias.name)
            yield bound, f"{alias.name if alias.asname else bound}:"
    elif isinstance(node, ast.ImportFrom):
        above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
        module = ".".join([*above, *([node.module] if node.module else [])])
        for alias in node.names:
            yield alias.asname or alias.name, f"{module}:{alias.name}"


def _free(node: ast.AST, package: str) -> set[str]:
    """What a piece of code names and does not bind itself."""
    if isinstance(node, ast.Name):
        return {node.id}
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return {f"{node.value.id}.{node.attr}"}
    if isinstance(node, _IMPORTS):
        return {target for _name, target in _imported(node, package)}
    inside: list[ast.AST] = []
    if isinstance(node, _FUNCTIONS):
        inside = [*node.body] if isinstance(node.body, list) else [node.body]
    elif isinstance(node, _COMPREHENSIONS):
        inside = list(ast.iter_child_nodes(node))
    bound = _bound(node, inside) if inside else set()
    found = {use for part in inside for use in _free(part, package) if _head(use) not in bound}
    for part in ast.iter_child_nodes(node):
        if part not in inside:
            found |= _free(part, package)
    return found | _quoted(node) | _imported_by_call(node)


def _bound(node: ast.AST, inside: list[ast.AST]) -> set[str]:
    """The local names of a function or comprehension."""
    arguments = getattr(node, "args", None)
    names = (
        {one.arg for one in ast.walk(arguments) if isinstance(one, ast.arg)} if arguments else set()
    )
    foreign = set()
    waiting = list(inside)
    while waiting:
        part = waiting.pop()
        if isinstance(part, (ast.Global, ast.Nonlocal)):
            foreign.update(part.names)
        elif isinstance(part, ast.Name):
            names.update([part.id] if isinstance(part.ctx, ast.Store) else ())
        elif isinstance(part, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            names.add(part.name)
        elif isinstance(part, _IMPORTS):
            names.update(name for name, _target in _imported(part, ""))
        elif not isinstance(part, (ast.Lambda, *_COMPREHENSIONS)):
            names.update([part.name] if isinstance(part, ast.ExceptHandler) and part.name else ())
            waiting.extend(ast.iter_child_nodes(part))
    return names - foreign


def _quoted(node: ast.AST) -> set[str]:
    """Names in quotes in the annotations of a node."""
    annotations = [getattr(node, name, None) for name in ("annotation", "returns")]
    return {
        one.value
        for annotation in annotations
        if annotation is not None
        for one in ast.walk(annotation)
        if isinstance(one, ast.Constant) and isinstance(one.value, str) and one.value.isidentifier()
    }


def _imported_by_call(node: ast.AST) -> set[str]:
    """Modules that `import_module` is given as a text, with a `*` for each part filled in."""
    if not isinstance(node, ast.Call) or not node.args:
        return set()
    if "import_module" not in (getattr(node.func, "id", ""), getattr(node.func, "attr", "")):
        return set()
    name = node.args[0]
    parts = name.values if isinstance(name, ast.JoinedStr) else [name]
    text = "".join(str(part.value) if isinstance(part, ast.Constant) else "*" for part in parts)
    return {f"{text}:"}


def _tree(node: Any) -> Any:  # noqa: ANN401 - a syntax tree, a list of such, or a constant
    """A syntax tree as nested tuples: nothing but what decides what the code does."""
    if isinstance(node, list):
        return [_tree(part) for part in node if not _is_prose(part)]
    if not isinstance(node, ast.AST):
        return node
    fields = [(name, getattr(node, name, None)) for name in node._fields if name not in _NO_PART]
    parts = [(name, _tree(value)) for name, value in fields if value is not None and value != []]
    return (type(node).__name__, *parts)


def _is_prose(node: Any) -> bool:  # noqa: ANN401 - a syntax tree or a constant
    """Whether a statement is a text: a docstring, of whatever it may be."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _head(name: str) -> str:
    return name.partition(".")[0]
