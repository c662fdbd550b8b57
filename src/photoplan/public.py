"""Public names of packages, loaded when they are first used, so that importing a package is quick.

Arguments are judged here by the types that requests and functions declare: one path where several may be given, text
for a path, NumPy's numbers and open datasets are brought into form; what cannot be meant is refused by name. Code
within the package uses the modules themselves, without this.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import importlib
import inspect
import os
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from photoplan.errors import UsageError

#: Types of single values that are judged; others are left to what takes them.
_PLAIN = (bool, int, float, str, Path)


def public(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package."""
    home = {name: module for module, names in homes.items() for name in names.split()}
    home |= {module: "" for module, names in homes.items() if not names}

    @functools.cache
    def load(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if not home[name]:
            return importlib.import_module(f"photoplan.{name}")
        thing = getattr(importlib.import_module(f"photoplan.{home[name]}"), name)
        judging = judged(thing)
        if judging is not thing:
            judging.__module__ = package  # where pickle finds it
        return judging

    names = sorted(home)
    return load, lambda: names, names


def judged(thing: Any) -> Any:
    """A request (the class itself) or a function that judges its arguments; anything else as it is."""
    if inspect.isclass(thing):
        if dataclasses.is_dataclass(thing) and thing.__name__.endswith("Request") and "judged" not in vars(thing):
            setattr(thing, "judged", True)  # noqa: B010
            setattr(thing, "__init__", _judged(getattr(thing, "__init__"), thing.__name__, thing))  # noqa: B009, B010
        return thing
    return _judged(thing, thing.__name__, thing) if inspect.isfunction(thing) else thing


def _judged(call: Callable[..., Any], name: str, hinted: Any) -> Callable[..., Any]:
    signature = inspect.signature(call)
    hints: dict[str, Any] = {}

    @functools.wraps(call)
    def judging(*arguments: Any, **named: Any) -> Any:
        if str(sys._getframe(1).f_globals.get("__name__", "")).startswith("photoplan."):
            return call(*arguments, **named)  # commands judge their options themselves
        if not hints:
            try:
                hints.update(get_type_hints(hinted))
            except NameError:  # a type that only checkers import
                hints["return"] = None
        try:
            bound = signature.bind(*arguments, **named)
        except TypeError:
            return call(*arguments, **named)
        for key, value in bound.arguments.items():
            if key in hints and signature.parameters[key].kind not in (_MANY, _NAMED):
                bound.arguments[key] = fitted(value, hints[key], f"{name}: {key}")
        return call(*bound.args, **bound.kwargs)

    return judging


_MANY, _NAMED = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD


def fitted(value: Any, hint: Any, where: str) -> Any:
    """A value in the form that a type hint declares; hints that are not judged leave it as it is."""
    kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    if value is None or Any in kinds or not all(map(_is_judged, kinds)):
        return value
    for kind in kinds:
        if get_origin(kind) is None and isinstance(kind, type) and type(value) is kind and kind is not float:
            return value
    if isinstance(getattr(value, "shape", None), tuple) and value.shape == () and hasattr(value, "item"):
        value = value.item()  # NumPy's numbers
    file = file_of(value)
    several = next((kind for kind in kinds if get_origin(kind) in (tuple, Sequence, list)), None)
    if Path in kinds and file is not None:
        return _path(file, where)
    if str in kinds and isinstance(value, str | os.PathLike):
        return os.fspath(value)
    if several is not None and (fits := _several(value, file, several, where)) is not None:
        return fits
    if bool in kinds and isinstance(value, bool):
        return value
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and (float in kinds or (int in kinds and float(value).is_integer())):
        if value != value:
            raise UsageError(f"{where} is not a number (NaN); give a finite one, or leave it out")
        return value if float in kinds else int(value)
    if any(isinstance(kind, type) and kind not in _PLAIN and isinstance(value, kind) for kind in kinds):
        return value
    raise UsageError(f"{where}: {described(value)}; needed is {' or '.join(map(_named, kinds))}{_advice(kinds)}")


def _is_judged(kind: Any) -> bool:
    """Whether a type says enough: plain values, tuples and lists of them, and classes of photoplan."""
    if kind is type(None) or kind in _PLAIN:
        return True
    if get_origin(kind) in (tuple, Sequence, list):
        return all(part is Ellipsis or _is_judged(part) for part in get_args(kind))
    own = isinstance(kind, type) and getattr(kind, "__module__", "").startswith("photoplan.")
    return own and not getattr(kind, "_is_protocol", False)


def _several(value: Any, file: Any, kind: Any, where: str) -> tuple[Any, ...] | None:
    """A tuple of several values, or of the one that is given where any number may be; None: neither."""
    parts = [part for part in get_args(kind) if part is not Ellipsis]
    any_number = get_origin(kind) is not tuple or Ellipsis in get_args(kind)
    if isinstance(value, str | os.PathLike) or file is not None:
        return (fitted(value, parts[0], where),) if any_number and (str in parts or Path in parts) else None
    if isinstance(value, dict) or not isinstance(value, Iterable):
        return None
    values = list(value)
    if any_number:
        return tuple(fitted(each, parts[0], f"{where}[{k}]") for k, each in enumerate(values))
    if len(values) != len(parts):
        raise UsageError(f"{where}: {len(values)} values; needed are {len(parts)}")
    return tuple(fitted(each, part, f"{where}[{k}]") for k, (each, part) in enumerate(zip(values, parts)))


def file_of(value: Any) -> str | os.PathLike[str] | None:
    """The file that a value names: text, a path, or a dataset that rasterio has opened from a file."""
    if isinstance(value, str | os.PathLike):
        return value
    name = getattr(value, "name", None)
    opened = type(value).__module__.startswith("rasterio") and isinstance(name, str) and Path(name).is_file()
    return name if opened else None


def _path(file: str | os.PathLike[str], where: str) -> Path:
    if not os.fspath(file).strip():
        raise UsageError(f"{where}: the name is empty; give the name of a file or folder")
    try:
        Path(file).stat()
    except (OSError, ValueError) as error:
        if not isinstance(error, OSError) or error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            why = getattr(error, "strerror", None) or error
            raise UsageError(
                f"{where} {os.fspath(file)[:60]!r}: no file can be there ({why}); give another name"
            ) from None
    return file if isinstance(file, Path) else Path(file)


def described(value: Any) -> str:
    """The type of a value, with what it holds if that is short."""
    kind = type(value).__name__
    text = repr(value) if isinstance(value, str | int | float | tuple | list | dict) else ""
    shape = f" of shape {value.shape}" if isinstance(getattr(value, "shape", None), tuple) else ""
    return f"{kind}{shape}" + (f" {text}" if text and len(text) <= 60 else "")


def _named(kind: Any) -> str:
    """A type in words."""
    if kind is type(None):
        return "None"
    if get_origin(kind) in (tuple, Sequence, list):
        parts = [part for part in get_args(kind) if part is not Ellipsis]
        return f"{'several' if Ellipsis in get_args(kind) or len(parts) == 1 else len(parts)} of {_named(parts[0])}"
    words = {str: "text", int: "a whole number", float: "a number", bool: "True or False", Path: "a path"}
    return words.get(kind, getattr(kind, "__name__", str(kind)))


def _advice(kinds: Iterable[Any]) -> str:
    names = {getattr(kind, "__name__", "") for kind in kinds}
    if "Project" in names:
        return " (photoplan.load_project gives it)"
    request = next((name for name in names if name.endswith("Request")), None)
    return f" (photoplan.{request}(…) gives it)" if request else ""
