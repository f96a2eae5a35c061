"""Headers of NumPy files. NumPy's own reader raises much that is undocumented on damaged ones."""

import ast
import io
import re
import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

_MAGIC = b"\x93NUMPY"
_LENGTH = {(1, 0): "<H", (2, 0): "<I"}
_MAX_HEADER = 10_000
_TYPE = re.compile(r"[<>|=](?:[biuf][1248]|O8?)")


@dataclass(frozen=True, kw_only=True)
class NpyHeader:
    """What a NumPy file says of its array."""

    shape: tuple[int, ...]
    order: Literal["C", "F"]
    dtype: np.dtype[Any]
    """Numbers, booleans or objects."""


def read_npy_header(stream: io.BytesIO) -> NpyHeader:
    """Read the header; the stream then stands where the numbers begin.

    Raises:
        ValueError: It is damaged, or of a type that holds anything but numbers or objects.
    """
    magic = stream.read(len(_MAGIC) + 2)
    layout = _LENGTH.get((magic[-2], magic[-1])) if len(magic) == len(_MAGIC) + 2 else None
    if not magic.startswith(_MAGIC) or layout is None:
        raise ValueError("no NumPy file of version 1 or 2")
    raw = stream.read(struct.calcsize(layout))
    length = struct.unpack(layout, raw)[0] if len(raw) == struct.calcsize(layout) else 0
    text = stream.read(length) if 0 < length <= _MAX_HEADER else b""
    if not text or len(text) < length:
        raise ValueError("damaged header of a NumPy file")
    try:
        table = ast.literal_eval(text.decode("latin1").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError("damaged header of a NumPy file") from error
    return _check(table)


def _check(table: Any) -> NpyHeader:
    if not isinstance(table, dict):
        raise ValueError("damaged header of a NumPy file")
    shape, kind, fortran = (table.get(key) for key in ("shape", "descr", "fortran_order"))
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"NumPy file of shape {shape!r}")
    if not (isinstance(kind, str) and _TYPE.fullmatch(kind) and isinstance(fortran, bool)):
        raise ValueError(f"NumPy file of type {kind!r}, expected numbers")
    return NpyHeader(shape=shape, order="F" if fortran else "C", dtype=np.dtype(kind))
