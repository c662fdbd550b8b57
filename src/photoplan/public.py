"""Public names of packages, loaded when they are first used, so that importing a package costs nothing."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def public(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package.

    Parameters
    ----------
    package : str
        Its `__name__`.
    homes : mapping
        Module of photoplan → names that it gives, with blanks between them; a name that is empty is the module itself.
    """
    home = {name: module for module, names in homes.items() for name in names.split()}
    home |= {module: "" for module, names in homes.items() if not names}

    def load(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if not home[name]:
            return importlib.import_module(f"photoplan.{name}")
        return getattr(importlib.import_module(f"photoplan.{home[name]}"), name)

    names = sorted(home)
    return load, lambda: names, names
