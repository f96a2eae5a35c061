"""NumPy arrays out of pickles, without unpickling.

Scene indices of D2-Net and LoFTR are object arrays, which NumPy stores as pickles, and a pickle can
name any function to be called. Here its opcodes are read one by one: plain containers, numbers,
text and bytes are put together, numpy's array classes are recognised by name and rebuilt by this
file, and any other name or opcode is refused. Nothing a file names is imported or called, and
nothing is allocated beyond the file's own length.
"""

import io
import math
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from l3r.errors import DataError

_RECONSTRUCT, _SCALAR, _NDARRAY, _DTYPE = "reconstruct", "scalar", "ndarray", "dtype"
_NAMES = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _DTYPE,
    **{
        (f"numpy.{core}.multiarray", name): kind
        for core in ("core", "_core")
        for name, kind in (("_reconstruct", _RECONSTRUCT), ("scalar", _SCALAR))
    },
}
_MAX_DEPTH = 16
"""Genuine indices nest five deep."""
_KINDS = ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "O", "O8")


@dataclass(frozen=True)
class _Name:
    """One of numpy's classes, recognised and not imported."""

    kind: str


@dataclass
class _Type:
    """A type of numbers, or of objects."""

    code: str
    order: str = "<"

    def set_state(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) >= 2 and state[1] in ("<", ">", "|", "=")):
            raise DataError("a type of numbers without byte order")
        self.order = str(state[1])

    @property
    def is_object(self) -> bool:
        return self.code.startswith("O")

    def to_numpy(self) -> np.dtype[Any]:
        return np.dtype(f"{self.order}{self.code}")


@dataclass
class _Array:
    """An array whose content may still be to come."""

    shape: tuple[int, ...] = ()
    is_fortran: bool = False
    content: Any = None
    """Numbers in one dimension, or a list of objects."""

    def set_state(self, state: Any) -> None:
        """Take (version, shape, type, order, content); content is bytes, or a list of objects."""
        if not (isinstance(state, tuple) and len(state) == 5):
            raise DataError("an array without shape, type and content")
        _, shape, kind, fortran, raw = state
        if not (
            isinstance(shape, tuple)
            and all(type(side) is int and side >= 0 for side in shape)
            and isinstance(kind, _Type)
        ):
            raise DataError("an array of no shape or type")
        count = math.prod(shape)
        if kind.is_object:
            good = isinstance(raw, list) and len(raw) == count
        else:
            good = isinstance(raw, bytes) and len(raw) == count * kind.to_numpy().itemsize
        if not good or len(shape) > _MAX_DEPTH:
            raise DataError(f"an array of shape {shape} with another amount of content")
        self.shape, self.is_fortran = shape, bool(fortran)
        self.content = raw if kind.is_object else np.frombuffer(raw, kind.to_numpy())

    def lay_out(self, flat: np.ndarray) -> np.ndarray:
        """Give an array of one dimension its shape."""
        return flat.reshape(self.shape, order="F" if self.is_fortran else "C")


def read_pickle(data: bytes) -> Any:
    """Read a pickle of plain containers, numbers, text and arrays.

    Args:
        data: The whole pickle; what follows its end is not looked at.

    Returns:
        Builtins and arrays; object arrays hold such in turn.

    Raises:
        DataError: It is damaged, or holds anything else.
    """
    machine = _Machine()
    try:
        for opcode, argument, _ in pickletools.genops(io.BytesIO(data)):
            name = opcode.name
            if name in _VALUES:
                machine.stack.append(argument)
            elif name in _MOVES:
                _MOVES[name](machine, argument)
            elif name == "STOP":
                return _finish(machine.pop(), {})
            elif name not in _FRAMING:
                raise DataError(f"a pickle with opcode {name}, expected plain values and arrays")
    except DataError:
        raise
    # pickletools raises these on damaged files, and the machine on an empty stack or memo.
    except (ValueError, IndexError, KeyError, TypeError, EOFError, OverflowError) as error:
        raise DataError(f"damaged pickle ({type(error).__name__}: {str(error)[:80]})") from error
    raise DataError("damaged pickle (no end)")


def _finish(value: Any, done: dict[int, Any], depth: int = 0) -> Any:
    """Replace what was recognised by arrays; what is named twice is built once."""
    if depth > _MAX_DEPTH:
        raise DataError(f"containers nested more than {_MAX_DEPTH} deep")
    if isinstance(value, _Name | _Type):
        raise DataError("a class in place of a value")
    if not isinstance(value, _Array | list | tuple | dict):
        return value
    if id(value) not in done:
        done[id(value)] = _finish_container(value, done, depth + 1)
    return done[id(value)]


def _finish_container(value: Any, done: dict[int, Any], depth: int) -> Any:
    if isinstance(value, dict):
        return {key: _finish(item, done, depth) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_finish(item, done, depth) for item in value)
    if value.content is None:
        raise DataError("an array without content")
    if isinstance(value.content, np.ndarray):
        return value.lay_out(value.content)
    flat = np.empty(len(value.content), dtype=object)
    for number, item in enumerate(value.content):
        flat[number] = _finish(item, done, depth)
    return value.lay_out(flat)


class _Machine:
    """The few moves of the pickle machine that plain data need."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def pop(self) -> Any:
        if self._marks and self._marks[-1] >= len(self.stack):
            raise DataError("damaged pickle (a mark out of place)")
        return self.stack.pop()

    def mark(self, argument: Any) -> None:
        self._marks.append(len(self.stack))

    def pop_mark(self) -> list[Any]:
        at = self._marks.pop()
        items = self.stack[at:]
        del self.stack[at:]
        return items

    def memoize(self, argument: int | None) -> None:
        self._memo[len(self._memo) if argument is None else argument] = self.stack[-1]

    def recall(self, argument: int) -> None:
        self.stack.append(self._memo[argument])

    def make_tuple(self, argument: Any, count: int | None = None) -> None:
        items = self.pop_mark() if count is None else [self.pop() for _ in range(count)][::-1]
        self.stack.append(tuple(items))

    def append(self, argument: Any) -> None:
        item = self.pop()
        self._top(list).append(item)

    def appends(self, argument: Any) -> None:
        items = self.pop_mark()
        self._top(list).extend(items)

    def set_item(self, argument: Any) -> None:
        value, key = self.pop(), self.pop()
        self._set_items([key, value])

    def set_items(self, argument: Any) -> None:
        self._set_items(self.pop_mark())

    def name(self, argument: str | None) -> None:
        if argument is None:
            name, module = self.pop(), self.pop()
        else:
            module, _, name = argument.partition(" ")
        if not (isinstance(module, str) and (module, name) in _NAMES):
            raise DataError(f"a pickle that names {module}.{name}, expected numpy's arrays alone")
        self.stack.append(_Name(_NAMES[module, name]))

    def reduce(self, argument: Any) -> None:
        arguments, what = self.pop(), self.pop()
        if not (isinstance(what, _Name) and isinstance(arguments, tuple) and arguments):
            raise DataError("a pickle that calls something, expected numpy's arrays alone")
        if what.kind == _RECONSTRUCT and arguments[0] == _Name(_NDARRAY):
            self.stack.append(_Array())
        elif what.kind == _DTYPE and arguments[0] in _KINDS:
            self.stack.append(_Type(arguments[0]))
        elif what.kind == _SCALAR and len(arguments) == 2:
            array = _Array()
            array.set_state((1, (), *_number(*arguments)))
            self.stack.append(array.content[0])
        else:
            raise DataError(f"a pickle with an unusual {what.kind} of numpy")

    def build(self, argument: Any) -> None:
        state = self.pop()
        if not isinstance(what := self.stack[-1], _Array | _Type):
            raise DataError("a pickle that sets an object's state, expected numpy's arrays alone")
        what.set_state(state)

    def _top(self, kind: type) -> Any:
        if type(self.stack[-1]) is not kind:
            raise DataError(f"damaged pickle (no {kind.__name__} to fill)")
        return self.stack[-1]

    def _set_items(self, items: list[Any]) -> None:
        target = self._top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str):
                raise DataError("a pickle with keys that are no text")
            target[key] = value


def _number(kind: Any, raw: Any) -> tuple[_Type, bool, bytes]:
    if not (isinstance(kind, _Type) and not kind.is_object):
        raise DataError("a number of no type")
    return kind, False, raw


_VALUES = frozenset(
    {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
    | {"SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"}
    | {"SHORT_BINBYTES", "BINBYTES", "BINBYTES8"}
)
_FRAMING = ("PROTO", "FRAME")
_MOVES: dict[str, Callable[[_Machine, Any], None]] = {
    "NONE": lambda machine, _: machine.stack.append(None),
    "NEWTRUE": lambda machine, _: machine.stack.append(True),
    "NEWFALSE": lambda machine, _: machine.stack.append(False),
    "EMPTY_LIST": lambda machine, _: machine.stack.append([]),
    "EMPTY_TUPLE": lambda machine, _: machine.stack.append(()),
    "EMPTY_DICT": lambda machine, _: machine.stack.append({}),
    "MARK": _Machine.mark,
    "MEMOIZE": _Machine.memoize,
    "BINPUT": _Machine.memoize,
    "LONG_BINPUT": _Machine.memoize,
    "BINGET": _Machine.recall,
    "LONG_BINGET": _Machine.recall,
    "TUPLE": _Machine.make_tuple,
    "TUPLE1": lambda machine, _: machine.make_tuple(None, 1),
    "TUPLE2": lambda machine, _: machine.make_tuple(None, 2),
    "TUPLE3": lambda machine, _: machine.make_tuple(None, 3),
    "APPEND": _Machine.append,
    "APPENDS": _Machine.appends,
    "SETITEM": _Machine.set_item,
    "SETITEMS": _Machine.set_items,
    "GLOBAL": _Machine.name,
    "STACK_GLOBAL": _Machine.name,
    "REDUCE": _Machine.reduce,
    "BUILD": _Machine.build,
}
