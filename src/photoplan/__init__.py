"""photoplan: photographs with known geometry become measurable pictures.

::

    import photoplan

    project = photoplan.load_project("brighton/project.toml")
    plan = photoplan.plan_orthophotos(project, resolution=0.1)
    print(plan)
    products = photoplan.execute(plan, "products")

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "load_project": "photoplan.io.project.file",
    "plan_orthophotos": "photoplan.products.orthophoto.plan",
    "execute": "photoplan.products.orthophoto.execution",
    "render": "photoplan.products.orthophoto.plan",
    "read_plan": "photoplan.products.orthophoto.plan_file",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'photoplan' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
