"""Values as bytes and back: JSON and raw arrays, which (unlike `pickle`) cannot run code.

What may be written is data: numbers, text, bytes, paths, enumerations, arrays of numbers or text, tuples, lists, sets,
mappings, and data classes that are registered by `storable`. Reading trusts nothing: types are compared with the
annotations of the class, sizes with the bytes that are there.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import struct
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import numpy as np

_T = TypeVar("_T", bound=type)
_MAGIC = b"PPDATA01"
_START = struct.Struct("<8sQ")
#: Bytes of JSON that are read, and levels of nesting: kept results have at most thousands of numbers outside arrays.
MOST_TEXT, MOST_LEVELS = 64 << 20, 60
_DTYPE = re.compile(r"[<>|]([biufc?])(1|2|4|8|16)|[<>|]([US])[1-9][0-9]{0,4}")
_CLASSES: dict[str, type] = {}


class NotData(ValueError):
    """A value that cannot be written, or bytes that are not what `encode` writes."""


def storable(cls: _T) -> _T:
    """Register a data class or enumeration, so that `decode` may build it; its `__post_init__` may only check."""
    _CLASSES[f"{cls.__module__}.{cls.__qualname__}"] = cls
    return cls


def encode(value: Any) -> bytes:
    """Return a value as bytes."""
    arrays: list[np.ndarray[Any, Any]] = []
    text = json.dumps(_tagged(value, arrays)).encode()
    return b"".join([_START.pack(_MAGIC, len(text)), text, *(a.tobytes() for a in arrays)])


def decode(content: bytes) -> Any:
    """Return the value that `encode` wrote."""
    try:
        magic, length = _START.unpack_from(content)
        if magic != _MAGIC or length > min(MOST_TEXT, len(content) - _START.size):
            raise NotData("the header is damaged")
        at = _START.size + length
        reader = _Reader(memoryview(content), at)
        value = reader.value(json.loads(content[_START.size : at]), 0)
        if reader.at != len(content):
            raise NotData("arrays do not end with the data")
    except NotData:
        raise
    except Exception as error:
        # Constructors of registered classes refuse values in their own ways.
        raise NotData(f"{type(error).__name__}: {error}") from error
    return value


def _tagged(value: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    """Return JSON in which every container is a list that begins with its kind."""
    if value is None or type(value) in (str, bool, int, float):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return ["array" if isinstance(value, np.ndarray) else "scalar", *_array(np.asarray(value), arrays)]
    if isinstance(value, bytes | bytearray | memoryview):
        return ["bytes", *_array(np.frombuffer(value, np.uint8), arrays)]
    if isinstance(value, complex):
        return ["complex", value.real, value.imag]
    if isinstance(value, Path):
        return ["path", str(value)]
    name = f"{type(value).__module__}.{type(value).__qualname__}"
    if isinstance(value, Enum) and name in _CLASSES:
        return ["enum", name, value.name]
    if dataclasses.is_dataclass(value) and name in _CLASSES:
        fields = [each.name for each in dataclasses.fields(value) if each.init]
        return ["class", name, {field: _tagged(getattr(value, field), arrays) for field in fields}]
    if type(value) in (tuple, list, set, frozenset):
        return [type(value).__name__, *(_tagged(item, arrays) for item in value)]
    if isinstance(value, Mapping):
        return ["dict", *([_tagged(k, arrays), _tagged(v, arrays)] for k, v in value.items())]
    raise NotData(f"a {name} is not data that can be kept; register it by `storable`")


_CONTAINERS: dict[str, type] = {"tuple": tuple, "list": list, "set": set, "frozenset": frozenset}


def _array(values: np.ndarray[Any, Any], arrays: list[np.ndarray[Any, Any]]) -> tuple[Any, ...]:
    """Return type and shape of an array, whose bytes come after the JSON; arrays of text objects are lists."""
    if values.dtype == object:
        items = values.ravel().tolist()
        if not all(item is None or type(item) in (str, bool, int, float) for item in items):
            raise NotData("an array of objects holds text and numbers only")
        return "object", list(values.shape), items
    kind: Any = values.dtype.str
    if values.dtype.names is not None:
        kind = [[name, values.dtype[name].str] for name in values.dtype.names]
        values = values.astype([(name, form) for name, form in kind])
    _dtype(kind)
    # Kernels are compiled for the order of memory: it is kept.
    order: Literal["C", "F"] = "F" if values.flags.f_contiguous and not values.flags.c_contiguous else "C"
    arrays.append(np.asarray(values, order=order).ravel(order))
    return kind, list(values.shape), order


def _dtype(kind: Any) -> np.dtype[Any]:
    if isinstance(kind, list):
        return np.dtype([(str(name), _dtype(form)) for name, form in kind])
    if not isinstance(kind, str) or not _DTYPE.fullmatch(kind):
        raise NotData(f"arrays of type {kind!r} are not kept")
    return np.dtype(kind)


@dataclasses.dataclass
class _Reader:
    """Builds values of JSON, and takes the bytes of arrays in their order."""

    content: memoryview
    at: int

    def value(self, item: Any, level: int) -> Any:
        """Return the value of one item."""
        if level > MOST_LEVELS:
            raise NotData("the values are nested too deeply")
        if not isinstance(item, list):
            if isinstance(item, dict):
                raise NotData("a table without a kind")
            return item
        kind, *rest = item
        if kind in ("array", "scalar", "bytes"):
            found = self.array(*rest)
            return found if kind == "array" else found[()] if kind == "scalar" else found.tobytes()
        if kind == "complex":
            return complex(float(rest[0]), float(rest[1]))
        if kind == "path":
            return Path(rest[0])
        if kind in ("enum", "class"):
            name, fields = rest
            return self.built(kind, name, fields, level + 1)
        if kind == "dict":
            return {self.value(k, level + 1): self.value(v, level + 1) for k, v in rest}
        return _CONTAINERS[kind](self.value(each, level + 1) for each in rest)

    def array(self, kind: Any, shape: list[int], items: Any) -> Any:
        """Return an array of its own memory; `items` are texts and numbers, or the order of memory."""
        if len(shape) > 8 or not all(type(n) is int and 0 <= n < 1 << 48 for n in shape):
            raise NotData(f"no array has the shape {shape!r}")
        count = math.prod(shape)
        if kind == "object":
            plain = isinstance(items, list) and all(not isinstance(each, list | dict) for each in items)
            if not plain or len(items) != count:
                raise NotData(f"{count} texts are missing")
            out = np.empty(count, object)
            out[:] = items
            return out.reshape(shape)
        dtype = _dtype(kind)
        length = count * dtype.itemsize
        if length > len(self.content) - self.at:
            raise NotData(f"an array of {length} bytes is not there")
        found = np.frombuffer(self.content[self.at : self.at + length], dtype, count).copy()
        self.at += length
        return found.reshape(shape, order="F" if items == "F" else "C")

    def built(self, kind: str, name: str, fields: Any, level: int) -> Any:
        """Return an object of a registered class, by its constructor, of values that fit its annotations."""
        cls = _CLASSES.get(name)
        if cls is None or (kind == "enum") != issubclass(cls, Enum):
            raise NotData(f"{name!r} is not registered")
        if issubclass(cls, Enum):
            return cls[fields]
        values = {str(field): self.value(item, level) for field, item in fields.items()}
        made: Any = cls
        hints: dict[str, Any] = _hints(made)
        wrong = [field for field, value in values.items() if field not in hints or not fits(value, hints[field])]
        if wrong:
            raise NotData(f"{name}.{wrong[0]} cannot be a {type(values[wrong[0]]).__name__}")
        return made(**values)


@cache
def _hints(cls: Any) -> dict[str, Any]:
    known = typing.get_type_hints(cls)
    return {each.name: known[each.name] for each in dataclasses.fields(cls) if each.init}


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of an annotated type; annotations of anything but data fit nothing."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any or hint is object:
        return True
    if hint is None or hint is type(None):
        return value is None
    if origin in (Union, types.UnionType):
        return any(fits(value, each) for each in args)
    if origin is typing.Annotated:
        return fits(value, args[0])
    if origin is Literal:
        return any(type(value) is type(each) and value == each for each in args)
    if origin is tuple:
        if len(args) == 2 and args[1] is Ellipsis:
            return isinstance(value, tuple) and all(fits(each, args[0]) for each in value)
        return isinstance(value, tuple) and len(value) == len(args) and all(map(fits, value, args))
    if origin is np.ndarray:
        scalar = typing.get_args(args[1])[0] if len(args) > 1 and typing.get_args(args[1]) else Any
        known = isinstance(scalar, type) and issubclass(scalar, np.generic)
        return isinstance(value, np.ndarray) and (not known or issubclass(value.dtype.type, scalar))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(fits(k, args[0]) and fits(v, args[1]) for k, v in value.items())
    if isinstance(origin, type) and issubclass(origin, Sequence | set | frozenset):
        return isinstance(value, origin) and not isinstance(value, str) and all(fits(each, args[0]) for each in value)
    if hint is float:
        return isinstance(value, float | int | np.floating) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int | np.integer) and not isinstance(value, bool)
    return isinstance(hint, type) and hint is not Callable and isinstance(value, hint)
