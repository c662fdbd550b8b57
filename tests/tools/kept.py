"""Expensive results kept from one run of the tests to the next, as long as the code and the inputs that made them are.

What is kept lies outside the checkout, in the user's folder of caches or where `PHOTOPLAN_TEST_CACHE` says. Its key
is a digest of the sources of all modules of photoplan that the making can import, of the tools and the module that make
it, of the inputs, and of the versions of the libraries that compute.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import photoplan

if os.name == "posix":
    import fcntl

_LIBRARIES = ("numpy", "numba", "scipy", "rasterio", "pyproj", "shapely", "opencv-python-headless", "pythoncdt")
_ROOTS = {"photoplan": Path(photoplan.__file__).parent, "tools": Path(__file__).parent}
_DAYS = 14
"""What nobody asked for in this time goes."""


def folder_of_cache() -> Path:
    """Where results are kept."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("PHOTOPLAN_TEST_CACHE") or Path(home) / "photoplan-tests")


def kept(name: str, make: Callable[[Path], None], code: Iterable[str], inputs: Iterable[Path] = ()) -> Path:
    """Folder that `make` filled, in this run or an earlier one; for reading only.

    Parameters
    ----------
    name
        Of the result, a word.
    make
        Gets an empty folder. Processes that want the same wait until the first of them has made it.
    code
        Modules that `make` runs, by their names; what they import is found. Those that the module of `make` imports are
        known without.
    inputs
        Files, and folders with all that is in them.
    """
    above = folder_of_cache()
    above.mkdir(parents=True, exist_ok=True)
    code, maker = list(code), Path(inspect.getfile(make))
    assert all(_source(module) for module in code), code
    with locked(above / f"{name}.lock"):
        folder = above / f"{name}-{_key(maker, [*code, *_imports(maker)], inputs)}"
        if not folder.is_dir():
            _forget(above)
            with tempfile.TemporaryDirectory(prefix=f".{name}-", dir=above) as made:
                result = Path(made) / "result"
                result.mkdir()
                make(result)
                result.rename(folder)
        os.utime(folder)
    return folder


def _forget(above: Path) -> None:
    for old in above.iterdir():
        if old.is_dir() and time.time() - old.stat().st_mtime > _DAYS * 86400:
            shutil.rmtree(old, ignore_errors=True)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Processes come in one after the other."""
    with path.open("w") as file:
        if os.name == "posix":
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _key(maker: Path, modules: Iterable[str], inputs: Iterable[Path]) -> str:
    digest = hashlib.sha256(sys.version.encode())
    for library in _LIBRARIES:
        try:
            digest.update(f"{library} {version(library)}".encode())
        except PackageNotFoundError:
            digest.update(library.encode())
    files = [maker, *(path for module in sorted(closure(modules)) if (path := _source(module)))]
    for given in inputs:
        files += sorted(path for path in given.rglob("*") if path.is_file()) if given.is_dir() else [given]
    for path in files:
        with path.open("rb") as file:
            digest.update(path.name.encode() + hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:20]


def closure(modules: Iterable[str]) -> set[str]:
    """Modules of photoplan and of the tests' tools that these can import, themselves included."""
    found: set[str] = set()
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        source = _source(module)
        if module not in found and source:
            found.add(module)
            waiting += [module.rpartition(".")[0], *_imports(source)]
    return found


@cache
def _source(module: str) -> Path | None:
    """File of a module; None for other names, as of functions, and for `photoplan` alone, which loads nothing."""
    first, *rest = module.split(".")
    if not rest or first not in _ROOTS:
        return None
    place = _ROOTS[first].joinpath(*rest)
    return next((path for path in (place.with_suffix(".py"), place / "__init__.py") if path.is_file()), None)


@cache
def _imports(path: Path) -> tuple[str, ...]:
    """Our own modules that a file imports anywhere in it, or names in full as registries do."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names.update(each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.update([node.module, *(f"{node.module}.{each.name}" for each in node.names)])
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            names.add(node.value)
    return tuple(name for name in names if re.fullmatch(r"\w+(\.\w+)+", name) and _source(name))
