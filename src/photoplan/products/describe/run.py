"""What a file holds, in words: rasters, terrain models, projects, plans, filters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.geometry.crs import crs_label
from photoplan.io.appearance import looks_like
from photoplan.io.filter_file import is_filter
from photoplan.io.plan_file import read_plan_tables
from photoplan.io.project.file import load_project
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.terrain.model_read import ModelReader, is_terrain_model
from photoplan.products.describe.model import describe_model
from photoplan.project.filter_files import load_filter
from photoplan.quality.restoration.borders import Convolution
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


def describe(path: Path) -> dict[str, Any]:
    """Facts of a file by name, as plain values; lists have a line each.

    Raises
    ------
    InputError
        The file is missing, damaged, or of no kind that is known.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    kind = path.suffix.lower()
    if kind == ".csv" or (kind == ".toml" and is_filter(path)):
        return describe_filter(path)
    if kind == ".toml":
        return _project(path)
    if is_terrain_model(path):
        return describe_model(ModelReader(path))
    if kind == ".gpkg":
        return _plan(path)
    if kind == ".json":
        return _record(path)
    return _raster(read_info(path))


def _project(path: Path) -> dict[str, Any]:
    project = load_project(path)
    return {
        "project": str(path),
        "crs": crs_label(project.crs),
        "terrain": (
            "none" if project.terrain is None else project.terrain.file or f"one height, {project.terrain.height} m"
        ),
        "cameras": [f"{name}: {camera.type}, lens {camera.lens.type}" for name, camera in project.cameras.items()],
        "orientation": f"{project.orientation.rotation}, {project.orientation.angle_unit}, "
        f"earth curvature {project.orientation.earth_curvature}",
        "images": [f"{image.name}: {image.file}" for image in project.images],
    }


def _plan(path: Path) -> dict[str, Any]:
    header, tiles = read_plan_tables(path)
    return {
        "plan": str(path),
        "made by": f"photoplan {header['photoplan']}",
        "settings": [f"{key} = {value}" for key, value in header["settings"].items()],
        "products": [f"{p['image']}, key {p['key'][:12]}" for p in header["products"]],
        "tiles": len(tiles["tile"]),
        "cells": int(tiles["cells"].sum()),
        "worst anchor residual": f"{float(tiles['residual_px'].max()):.3g} px" if len(tiles["tile"]) else "none",
    }


def _record(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no readable JSON ({error}){looks_like(path)}") from None
    if not isinstance(content, dict) or "product" not in content:
        raise InputError(f"{path}: no run record of photoplan{looks_like(path)}")
    return {
        str(key): value if isinstance(value, (str, int, float)) else json.dumps(value) for key, value in content.items()
    }


def _raster(info: RasterInfo) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "raster": str(info.path),
        "format": info.driver,
        "size": f"{info.size[0]} × {info.size[1]} pixels",
        "bands": f"{info.bands} of {info.dtype}" + (f", {info.bits} bits used" if info.bits else ""),
        "colours": ", ".join(info.colours),
        "blocks": f"{info.block[0]} × {info.block[1]}",
        "overviews": ", ".join(f"1/{f}" for f in info.overviews) or "none",
        "nodata": "none" if info.nodata is None else f"{info.nodata:g}",
        "mask": "yes" if info.has_mask or info.alpha_bands else "no",
    }
    if info.crs is not None:
        facts["crs"] = crs_label(info.crs)
        facts["heights"] = "not stated" if info.vertical_crs is None else crs_label(info.vertical_crs)
    if info.to_map is not None:
        x0, xx, _, y0, _, yy = info.to_map
        facts["first pixel's centre"] = f"X {x0:.4f}, Y {y0:.4f}"
        facts["pixel"] = f"{xx:g} × {abs(yy):g}"
    if info.warnings:
        facts["note"] = list(info.warnings)
    return facts
