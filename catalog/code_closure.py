"""The code that a stage runs, found from its source: what an artefact's name must follow.

Starting at a build function, everything counts that it reaches by name, symbol by symbol: in its
signature, its decorators and its body, through imports at the top of a module or inside a function,
from project module to project module. A symbol is a function, a class or a constant at the top of a
module (see `source_outlines`). With the first symbol of a module counts what the module and the
packages around it run when they are imported. A module that is used as an object, or imported by
`import_module("a.b")`, counts whole. Where a function imports by `import_module(f"a.{x}.{y}")`, as
`kernels/backends.py` does, each package that calls it counts its own modules of that pattern whole:
all backends of its kernel.

Nothing is imported to find this, and nothing is listed by hand. Two things are not seen: objects
that a caller makes from classes that the build neither makes nor names in an annotation, and
changes that one module makes to another one while it is imported. The catalog is not followed: it
carries bytes, and does not decide what lies in an artefact.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, partial
from importlib.resources import files
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any, NamedTuple

from catalog.digests import canonical_json, digest_text
from catalog.errors import IdentityError
from catalog.source_outlines import RUNNING, Outline, outline_of

WHOLE = "*"
"""Every symbol of a module."""


class Place(NamedTuple):
    """A symbol of a module."""

    module: str
    name: str


@dataclass(frozen=True)
class Code:
    """The code behind an artefact."""

    starts: tuple[str, ...]
    """The build function and the functions bound to it, each `module:name`."""
    modules: Mapping[str, str]
    """Digest of what is reached in each module."""

    @cached_property
    def digest(self) -> str:
        """One digest of it all."""
        return digest_text(canonical_json([self.starts, self.modules]))


class SourceTree:
    """The source of some packages, as it was when first looked at.

    Looked at once: the modules in memory are those that were read when the process started.
    """

    def __init__(self, roots: Mapping[str, Path]) -> None:
        """Take the folders of the packages, by their names."""
        self._roots = roots
        self._outlines: dict[str, Outline] = {}
        self._next: dict[Place, set[Place]] = {}

    @classmethod
    def of_packages(cls, *names: str) -> "SourceTree":
        """The source of packages that can be imported."""
        return cls({name: Path(str(files(name))) for name in names})

    def code(self, *builds: Callable[..., Any]) -> Code:
        """The code that build functions run, each a function or a `partial` of one.

        Raises:
            IdentityError: what runs cannot be found from the source.
        """
        return self.code_from(start for build in builds for start in self._starts(build))

    def code_from(self, starts: Iterable[str]) -> Code:
        """The code that is reached from symbols, each `module:name`.

        Raises:
            IdentityError: what runs cannot be found from the source.
        """
        starts = tuple(sorted(set(starts)))
        waiting = [Place(*start.split(":")) for start in starts]
        seen: set[Place] = set()
        while waiting:
            place = waiting.pop()
            if place not in seen:
                seen.add(place)
                if place not in self._next:
                    self._next[place] = set(self._reached(place))
                waiting += self._next[place]
        symbols: dict[str, dict[str, str]] = defaultdict(dict)
        for module, name in seen:
            if symbol := self._outline(module).symbols.get(name):
                symbols[module][name] = symbol.digest
        digests = {name: digest_text(canonical_json(found)) for name, found in symbols.items()}
        return Code(starts, dict(sorted(digests.items())))

    def _reached(self, place: Place) -> Iterator[Place]:
        """What counts as soon as a symbol does."""
        module, name = place
        outline = self._outline(module)
        yield Place(module, RUNNING)
        package = module.rpartition(".")[0]
        if self._found(package) is not None:
            yield Place(package, RUNNING)
        if name == WHOLE:
            yield from (Place(module, each) for each in outline.symbols)
        elif name in outline.symbols:
            for use in outline.symbols[name].names:
                for target in self._targets(module, use):
                    yield target
                    yield from self._filled_in(module, target)
        elif name != RUNNING:
            raise IdentityError(f"{module} has no {name!r} at its top level")

    def _targets(self, module: str, use: str) -> Iterator[Place]:
        """The places that a name stands for where it is used."""
        if ":" in use:
            if WHOLE not in use:  # patterns are filled in for whoever calls
                yield from self._imported(module, use)
            return
        outline = self._outline(module)
        head, _, attribute = use.partition(".")
        if head in outline.symbols:
            yield Place(module, head)
        for origin in outline.imports.get(head, ()):
            for target in self._imported(module, origin):
                is_module = target.name == WHOLE and attribute
                found = f"{target.module}:{attribute}"
                yield from self._imported(module, found) if is_module else [target]

    def _imported(self, asker: str, origin: str) -> Iterator[Place]:
        """The place of `module:name`, wherever the module has it from; none outside the roots."""
        module, _, name = origin.partition(":")
        if module.partition(".")[0] not in self._roots:
            return
        if self._found(module) is None:
            raise IdentityError(f"{asker} imports {module}, which has no source")
        outline = self._outline(module)
        if not name:
            yield Place(module, WHOLE)
        elif name in outline.symbols:
            yield Place(module, name)
        elif name in outline.imports:
            yield Place(module, RUNNING)
            yield from self._targets(module, name)
        elif self._found(f"{module}.{name}"):
            yield Place(f"{module}.{name}", WHOLE)
        elif not name.startswith("__"):  # such as __file__, which every module has
            raise IdentityError(f"{asker} imports {name!r} from {module}, which does not have it")

    def _filled_in(self, asker: str, target: Place) -> Iterator[Place]:
        """The modules of a package that a function it calls imports by a pattern."""
        symbol = self._outline(target.module).symbols.get(target.name)
        for pattern in (use for use in (symbol.names if symbol else ()) if WHOLE in use):
            file = self._path(asker)
            package = asker if file.name == "__init__.py" else asker.rpartition(".")[0]
            names = [f"{package}.{path.stem}" for path in file.parent.glob("[!_]*.py")]
            found = [name for name in names if fnmatchcase(f"{name}:", pattern)]
            if not found:
                raise IdentityError(f"{asker} asks for {pattern[:-1]}, of which it holds no module")
            yield from (Place(name, WHOLE) for name in found)

    def _outline(self, module: str) -> Outline:
        if module not in self._outlines:
            self._outlines[module] = outline_of(module, self._path(module))
        return self._outlines[module]

    def _path(self, module: str) -> Path:
        path = self._found(module)
        if path is None:
            raise IdentityError(f"there is no source of {module} in {', '.join(self._roots)}")
        return path

    def _found(self, module: str) -> Path | None:
        root, *parts = module.split(".")
        if root not in self._roots:
            return None
        folder = self._roots[root].joinpath(*parts)
        places = (folder / "__init__.py", folder.with_suffix(".py"))
        return next((place for place in places if place.is_file()), None)

    def _starts(self, build: Any) -> Iterator[str]:  # noqa: ANN401 - a function, or what is bound
        """A build's function, and the functions and the classes of the objects bound to it."""
        if isinstance(build, partial):
            for part in (build.func, *build.args, *build.keywords.values()):
                yield from self._starts(part)
            return
        if isinstance(build, (MethodType, BuiltinFunctionType)):
            raise IdentityError(f"{build.__qualname__} is no function of a module, as a build must")
        what = build if isinstance(build, (FunctionType, type)) else type(build)
        if "<locals>" in what.__qualname__:
            raise IdentityError(f"{what.__qualname__} stands inside a function, as no build may")
        place = Place(what.__module__, what.__qualname__.partition(".")[0])
        if isinstance(build, FunctionType) or place.module.partition(".")[0] in self._roots:
            yield ":".join(place)
