"""What a restoration filter holds, in words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from photoplan.project.filter_files import load_filter
from photoplan.quality.restoration.convolution import Convolution
from photoplan.quality.restoration.filters import FilterKernel


def describe_filter(path: Path) -> dict[str, Any]:
    """Facts of a filter file by name, as plain values; lists have a line each."""
    used = load_filter(path)
    columns, rows = used.margin
    facts: dict[str, Any] = {
        "filter": str(path),
        "made": used.description or "not stated",
        "reach": f"{2 * columns + 1} × {2 * rows + 1} pixels",
        "noise": f"grows {used.noise_gain:.4g} times" + (" at most" if len(used.kernels) > 1 else ""),
        "kernels": [_kernel(kernel) for kernel in used.kernels],
    }
    if used.image_size is not None:
        facts["images"] = f"{used.image_size[0]} × {used.image_size[1]} pixels"
    for name, value in used.facts.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            facts[str(name)] = f"{len(value)}, see the file"
        else:
            facts[str(name)] = value if isinstance(value, str | int | float) else str(value)
    return facts


def _kernel(kernel: FilterKernel) -> str:
    rows, columns = kernel.values.shape
    even = "symmetric" if Convolution(kernel).even else "general"
    return f"{place_of(kernel)}: {columns} × {rows}, {even}, sum {kernel.total:.4g}, noise gain {kernel.noise_gain:.4g}"


def place_of(kernel: FilterKernel) -> str:
    """Band and place in the field of a kernel."""
    band = "all bands" if kernel.band is None else f"band {kernel.band}"
    return band if kernel.at is None else f"{band} at {kernel.at[0]:g}, {kernel.at[1]:g}"
