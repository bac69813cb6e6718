"""Read a pickle as data instead of running it.

A pickle is a program for a small stack machine whose REDUCE and NEWOBJ opcodes call whatever the
file names. This reader steps through the same opcodes but never imports, calls or builds anything:
a name becomes `Named`, a call becomes `Made`, both inert. Names outside the caller's allow-list are
refused. The opcodes are those of the standard library's `pickletools`; the ones left out
(persistent ids, the extension registry, old class instances, sets) no table uses. Keys of dicts
are texts and numbers: hashing a tuple nested a million deep would overflow the C stack.
"""

import pickletools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from lidarpainter_models.errors import DataError, UnsafePickleError
from lidarpainter_models.scenes.validation import shown


class Named(NamedTuple):
    """A class or function that the pickle names."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(eq=False, slots=True)
class Made:
    """What the pickle would have made: `by(*arguments)`, then `__setstate__(state)`."""

    by: Named
    arguments: tuple
    state: Any = field(default=None)


MAX_OPCODES = 100_000
"""A pickle with more is refused; those of PandaSet have a few thousand."""

_MARK = object()
_LITERALS = (
    *("INT", "LONG", "FLOAT", "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE"),
    *("BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
)


class _Machine:
    """The stack and the memo of one pickle."""

    def __init__(self, allowed: frozenset[Named]) -> None:
        self.allowed = allowed
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.actions: dict[str, Callable[[Any], object]] = {
            **dict.fromkeys(_LITERALS, self.stack.append),
            **dict.fromkeys(("PROTO", "FRAME"), lambda _: None),
            "NONE": lambda _: self.stack.append(None),
            "NEWTRUE": lambda _: self.stack.append(True),
            "NEWFALSE": lambda _: self.stack.append(False),
            "EMPTY_TUPLE": lambda _: self.stack.append(()),
            "EMPTY_LIST": lambda _: self.stack.append([]),
            "EMPTY_DICT": lambda _: self.stack.append({}),
            "TUPLE1": lambda _: self._push_tuple(1),
            "TUPLE2": lambda _: self._push_tuple(2),
            "TUPLE3": lambda _: self._push_tuple(3),
            "MARK": lambda _: self._mark(),
            **dict.fromkeys(
                ("BINGET", "LONG_BINGET", "GET"), lambda key: self.stack.append(self.memo[key])
            ),
            **dict.fromkeys(("BINPUT", "LONG_BINPUT", "PUT"), self._put),
            **dict.fromkeys(("REDUCE", "NEWOBJ"), self._make),
            "MEMOIZE": lambda _: self._put(len(self.memo)),
            "TUPLE": lambda _: self.stack.append(tuple(self._pop_to_mark())),
            "LIST": lambda _: self.stack.append(self._pop_to_mark()),
            "DICT": lambda _: self.stack.append(_pairs(self._pop_to_mark())),
            "APPEND": lambda _: self._extend([self.stack.pop()]),
            "APPENDS": lambda _: self._extend(self._pop_to_mark()),
            "SETITEM": lambda _: self._update([self.stack.pop(), self.stack.pop()][::-1]),
            "SETITEMS": lambda _: self._update(self._pop_to_mark()),
            "GLOBAL": lambda text: self._name(*text.split(" ", 1)),
            "STACK_GLOBAL": lambda _: self._name(*[self.stack.pop(), self.stack.pop()][::-1]),
            "BUILD": lambda _: self._set_state(self.stack.pop()),
            "POP": lambda _: self.stack.pop(),
            "POP_MARK": lambda _: self._pop_to_mark(),
            "DUP": lambda _: self.stack.append(self.stack[-1]),
        }

    def _push_tuple(self, size: int) -> None:
        items = tuple(self.stack[-size:])
        del self.stack[-size:]
        self.stack.append(items)

    def _mark(self) -> None:
        self.marks.append(len(self.stack))
        self.stack.append(_MARK)

    def _pop_to_mark(self) -> list[Any]:
        position = self.marks.pop()
        if self.stack[position] is not _MARK:
            raise DataError("the pickle is damaged: a mark is gone")
        items = self.stack[position + 1 :]
        del self.stack[position:]
        return items

    def _put(self, key: int) -> None:
        self.memo[key] = self.stack[-1]

    def _extend(self, items: list[Any]) -> None:
        _expect(self.stack[-1], list).extend(items)

    def _update(self, items: list[Any]) -> None:
        _expect(self.stack[-1], dict).update(_pairs(items))

    def _name(self, module: str, name: str) -> None:
        named = Named(_expect(module, str), _expect(name, str))
        if named not in self.allowed:
            raise UnsafePickleError(
                f"the pickle names {shown(str(named))}, which no table needs; nothing of it was run"
            )
        self.stack.append(named)

    def _make(self, _: object) -> None:
        arguments = _expect(self.stack.pop(), tuple)
        self.stack.append(Made(_expect(self.stack.pop(), Named), arguments))

    def _set_state(self, state: object) -> None:
        _expect(self.stack[-1], Made).state = state


def _expect(value: Any, kind: type) -> Any:  # noqa: ANN401
    if not isinstance(value, kind):
        raise DataError(f"the pickle is damaged: expected {kind.__name__}, got {type(value)}")
    return value


def _pairs(items: list[Any]) -> dict[Any, Any]:
    if not all(isinstance(key, str | int) for key in items[::2]):
        raise DataError("the pickle is damaged: a key is neither a text nor a number")
    return dict(zip(items[::2], items[1::2], strict=True))


def read_pickle_tree(content: bytes, allowed: Iterable[Named]) -> Any:  # noqa: ANN401
    """The value a pickle describes, with `Made` and `Named` in place of objects and classes.

    Raises:
        UnsafePickleError: the pickle names something outside `allowed` or uses an opcode that
            tables do not need.
        DataError: the pickle is damaged or cut off.
    """
    machine = _Machine(frozenset(allowed))
    try:
        for step, (opcode, argument, _position) in enumerate(pickletools.genops(content)):
            if step >= MAX_OPCODES:
                raise DataError(f"the pickle has more than {MAX_OPCODES} opcodes")
            if opcode.name == "STOP":
                return machine.stack.pop()
            action = machine.actions.get(opcode.name)
            if action is None:
                raise UnsafePickleError(
                    f"the pickle uses the opcode {opcode.name}, which no table needs"
                )
            action(argument)
    except (IndexError, KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"the pickle is damaged: {shown(str(error))}") from None
    raise DataError("the pickle is damaged: it has no end")
