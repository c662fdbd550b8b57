"""Descriptions of files: rasters, rational polynomials, terrain models, projects, plans, filters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.errors import InputError, PhotoplanError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.crs import crs_label
from photoplan.geometry.heights import height_label
from photoplan.io.camera.line import describe_line, is_line, read_line_correction
from photoplan.io.camera.satellite import is_frame, is_rpc, read_frame, read_rpc, rpc_beside, rpc_in
from photoplan.io.files import format_hint, raster_driver, read_json, read_toml
from photoplan.io.formats import choose_format, read_cameras, read_orientation_block
from photoplan.io.objects import read_objects
from photoplan.io.orientation.block import TableFormat
from photoplan.io.points import (
    is_gcp_list,
    read_gcp_list,
    read_ground_points,
    read_image_points,
    read_observed_positions,
)
from photoplan.io.project.file import load_project
from photoplan.io.project.model import ImageEntry
from photoplan.io.quality_files import (
    is_filter,
    read_balance_file,
    read_chromatic,
    read_fall_off_entry,
    read_mtf_table,
    read_sensor,
)
from photoplan.io.raster import with_alpha_judged
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.series import read_series
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.model import GrossError, ModelReader, is_terrain_model
from photoplan.io.vector_layer import layers_of, read_layer, read_plan_tables
from photoplan.plain import pick
from photoplan.products.simulate import stated_model
from photoplan.project.steps import load_filter
from photoplan.quality.restoration.restorer import Convolution, FilterKernel
from photoplan.requests.project import DescribeRequest
from photoplan.requests.terrain import InfoRequest
from photoplan.surfaces.units import LineElement, UnitFigures


def describe_filter(path: Path) -> dict[str, Any]:
    """Return facts of a filter file by name, as plain values; lists have a line each."""
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
    """Return the band and the place in the field of a kernel."""
    band = "all bands" if kernel.band is None else f"band {kernel.band}"
    return band if kernel.at is None else f"{band} at {kernel.at[0]:g}, {kernel.at[1]:g}"


@dataclass(frozen=True)
class FileFacts(Result):
    """Facts of a file, by name."""

    file: Path
    facts: Mapping[str, Any]

    def json_fields(self) -> Mapping[str, Any]:
        """Facts by name."""
        return self.facts

    def written(self) -> Sequence[Path]:
        """Return nothing: the file is read."""
        return ()

    def summary(self) -> Sequence[str]:
        """Return the facts as lines; long ones have several."""
        width = max(len(key) for key in self.facts)
        texts = {key: readable(value) for key, value in self.facts.items()}
        rows = {key: text if isinstance(text, list) else [text] for key, text in texts.items()}
        return [f"{key * (k == 0):<{width}}  {line}" for key, lines in rows.items() for k, line in enumerate(lines)]


def describe_file(request: DescribeRequest, events: Events = SILENT) -> FileFacts:
    """Describe a file of any kind; see `describe`."""
    return FileFacts(request.file, describe(request.file))


def describe(path: Path) -> dict[str, Any]:
    """Return facts of a file by name, as plain values; lists have a line each."""
    if path.is_dir():
        return _oriented(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    kind = path.suffix.lower()
    if is_line(path):
        return {"file": str(path), **describe_line(path), **(read_rpc(path).describe() if is_rpc(path) else {})}
    if is_frame(path):
        return {"file": str(path), **read_frame(path).describe()}
    if is_terrain_model(path):
        return describe_model(ModelReader(path))
    if is_rpc(path) or kind == ".geom":
        return {"file": str(path), **read_rpc(path).describe()}
    if kind == ".toml":
        return _toml(path)
    if kind == ".gpkg":
        try:
            return _plan(path)
        except InputError:
            if (found := _first(path, (_vectors,))) is None:
                raise
            return found
    if kind == ".json" and (record := _record(path)) is not None:
        return record
    try:
        raster_driver(path)
    except InputError as not_a_raster:
        readers = _READERS.get("".join(path.suffixes[-2:]).lower()) or _READERS.get(kind, _TEXTS)
        if len(readers) == 1:
            return readers[0](path)
        found = _first(path, readers)
        if found is None and kind == ".json":
            raise InputError(
                f"{path}: JSON of no kind that is known: neither a run record of photoplan nor orientations, cameras, "
                f"objects or vectors{format_hint(path)}"
            ) from None
        if found is None and kind == ".xml":
            return {"file": str(path), **read_rpc(path).describe()}
        if found is None:
            raise not_a_raster from None
        return found
    return _raster(with_alpha_judged(read_info(path)))


def _first(path: Path, readers: Sequence[Callable[[Path], dict[str, Any]]]) -> dict[str, Any] | None:
    """Return facts from the first reader that understands a file; None if none does."""
    for reader in readers:
        try:
            return reader(path)
        except PhotoplanError:
            continue
    return None


def _toml(path: Path) -> dict[str, Any]:
    """Return facts of a TOML file of any kind."""
    contents, _ = read_toml(path)
    if "images" in contents:
        try:
            return _project(path)
        except InputError:
            # Orientations alone are images without files.
            if (found := _first(path, (_oriented,))) is None:
                raise
            return found
    if is_filter(path):
        return describe_filter(path)
    if "cameras" in contents:
        return _cameras(path)
    for title, read in _TOMLS.items():
        try:
            read(path)
        except PhotoplanError:
            continue
        return {title: str(path), **contents}
    raise InputError(
        f"{path}: TOML of no kind that is known, with the entries {', '.join(list(contents)[:8]) or '(none)'}; known "
        f"are projects, cameras, filters, {', '.join(_TOMLS)}"
    )


def readable(value: Any) -> Any:
    """Return a value as text; tables and lists of tables have a line for each entry, long ones their first lines."""
    if isinstance(value, dict):
        lines = [f"{name}: {_short(each)}" for name, each in value.items()]
    elif isinstance(value, list):
        lines = [_short(each) for each in value]
        if not any(isinstance(each, dict | list) for each in value) and len(value) > _MOST_LINES:
            return _short(value)
    else:
        return _short(value)
    return lines if len(lines) <= _MOST_LINES else [*lines[: _MOST_LINES - 1], f"… {len(lines)} entries in all"]


def _short(value: Any) -> str:
    """Return a value in one line."""
    if isinstance(value, dict):
        text = ", ".join(f"{name} {_short(each)}" for name, each in value.items() if each not in (None, [], {}))
    elif isinstance(value, list):
        text = ", ".join(_short(each) for each in value[:6]) + (f" … ({len(value)})" if len(value) > 6 else "")
    elif isinstance(value, bool) or value is None:
        text = {True: "yes", False: "no", None: "none"}[value]
    else:
        text = f"{value:.10g}" if isinstance(value, float) else str(value)
    text = text or "none"
    return text if len(text) <= _MOST_LETTERS else text[: _MOST_LETTERS - 1] + "…"


def _cameras(path: Path) -> dict[str, Any]:
    found = read_cameras(path)
    lines = []
    for name, camera in found.cameras.items():
        size = "size of each image" if camera.size is None else f"{camera.size[0]} × {camera.size[1]} pixels"
        lines.append(f"{name}: {camera.type}, {size}, lens {camera.lens.type}")
    return {"cameras": str(path), "count": len(lines), "list": lines}


def _oriented(path: Path) -> dict[str, Any]:
    form = choose_format(path, TableFormat())
    block = read_orientation_block(path, format=form.name)
    table = block.table
    facts: dict[str, Any] = {
        "orientations": str(path),
        "format": form.title,
        "images": f"{len(table.images)}: {', '.join(i.name for i in table.images[:3])}{' …' * (len(table.images) > 3)}",
        "crs": "not stated" if table.crs is None else crs_label(table.crs),
        "cameras": [f"{name}: {camera.type}, lens {camera.lens.type}" for name, camera in block.cameras.items()]
        or "none",
    }
    return facts | ({"note": list(table.notes)} if table.notes else {})


def _image_points(path: Path) -> dict[str, Any]:
    points = read_image_points(path)
    return {
        "image points": str(path),
        "measurements": f"{len(points)} of {len(points.points)} points in {len(points.images)} images",
    }


def _ground_points(path: Path) -> dict[str, Any]:
    points = read_ground_points(path)
    return {
        "ground points": str(path),
        "points": f"{len(points)}: {', '.join(points.names[:5])}",
        "extent": _extent(points.XYZ),
    }


def _positions(path: Path) -> dict[str, Any]:
    table = read_observed_positions(path)
    return {"positions": str(path), "images": len(table.images), "extent": _extent(table.XYZ)}


def _control_list(path: Path) -> dict[str, Any]:
    if not is_gcp_list(path):
        raise InputError(f"{path}: not a control list")
    found = read_gcp_list(path)
    return {
        "control list": str(path),
        "crs": crs_label(found.crs),
        "points": f"{len(found.ground)}, measured {len(found.points)} times in {len(found.points.images)} images",
    }


def _measured(path: Path) -> dict[str, Any]:
    found = read_measured([path])
    counts = Counter(getattr(line, "kind", "lines") for line in found.lines)
    return {
        "terrain data": str(path),
        "crs": "not stated" if found.crs is None else crs_label(found.crs),
        "points": len(found.points),
        "lines": readable(dict(counts)) if counts else "none",
    }


def _objects(path: Path) -> dict[str, Any]:
    found = read_objects(path)
    return {"objects": str(path), "count": len(found.names), "triangles": len(found.corners)}


def _vectors(path: Path) -> dict[str, Any]:
    lines = []
    for name in layers_of(path):
        layer = read_layer(path, name)
        kinds = Counter("no geometry" if shape is None else shape.geom_type for shape in layer.shapes)
        told = ", ".join(f"{count} {kind}" for kind, count in kinds.items()) or "empty"
        fields = ", ".join(list(layer.fields)[:8]) or "none"
        lines.append(f"{name}: {told}; fields {fields}; {'no CRS' if layer.crs is None else crs_label(layer.crs)}")
    return {"vectors": str(path), "layers": lines or "none"}


def _extent(XYZ: Any) -> str:
    low, high = np.nanmin(XYZ, axis=0), np.nanmax(XYZ, axis=0)
    return ", ".join(f"{name} {a:.3f} to {b:.3f}" for name, a, b in zip("XYZ", low, high))


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
        "images": [_image(image) for image in project.images],
    }


def _image(image: ImageEntry) -> str:
    geometry = "" if image.described_by else f", geometry in {image.geometry_file or 'the file itself'}"
    return f"{image.name}: {image.file}{geometry}"


def _plan(path: Path) -> dict[str, Any]:
    header, tiles = read_plan_tables(path)
    return {
        "plan": str(path),
        "made by": f"photoplan {header['photoplan']}",
        "settings": [f"{key} = {value}" for key, value in header["settings"].items()],
        "products": [f"{p['name']}, key {p['key'][:12]}" for p in header["products"]],
        "tiles": len(tiles["tile"]),
        "cells": int(tiles["cells"].sum()),
        "worst anchor residual": f"{float(tiles['residual_px'].max()):.3g} px" if len(tiles["tile"]) else "none",
    }


def _record(path: Path) -> dict[str, Any] | None:
    """Return facts of a run record; None if the file is another JSON."""
    content = read_json(path)
    if not isinstance(content, dict) or not {"key", "versions"} <= content.keys():
        return None
    return {"run record": str(path), **content}


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
        facts["heights"] = height_label(info.height_system) + (
            f", in {info.band_unit}" if info.band_unit is not None and len(info.colour_bands) == 1 else ""
        )
    if info.to_map is not None:
        x0, xx, _, y0, _, yy = info.to_map
        facts["first pixel's centre"] = f"X {x0:.4f}, Y {y0:.4f}"
        facts["pixel"] = f"{xx:g} × {abs(yy):g}"
    rpc, beside = rpc_in(info.path), rpc_beside(info.path)
    if rpc is not None:
        facts |= rpc.describe()
    elif beside:
        facts["rational polynomials"] = f"in {', '.join(path.name for path in beside)} beside it"
    if info.warnings:
        facts["note"] = list(info.warnings)
    return facts


def describe_model(reader: ModelReader) -> dict[str, Any]:
    """Return facts of a terrain model by name, as texts; lists have a line each."""
    f = model_figures(reader)
    low, high = f["heights"]
    xmin, ymin, xmax, ymax = f["bounds"]
    facts: dict[str, Any] = {
        "terrain model": f["model"],
        "made by": f["made_by"],
        "crs": crs_label(f["crs"]),
        "heights": "none" if low is None else f"{low:.3f} to {high:.3f} m, {height_label(f['height_system'])}",
        "bounds": f"{xmin:.3f} {ymin:.3f} {xmax:.3f} {ymax:.3f}",
        "units": f"{f['units']} of {f['side']:g} m ({f['columns']} × {f['rows']} places, {f['empty']} empty)",
        "grid widths": [f"{w['width']:g} m in {w['units']} units" for w in f["widths"]],
        "posts": f["posts"],
        "measured": f"{f['points']} points",
        "lines": _lines_in_words(f["lines"]),
    }
    if f["family"]:
        facts["covariance"] = f"{f['family']}, half length {_number(f['length'])} m, signal {_number(f['signal'])} m"
    facts["accuracy"] = (
        f"posts {_number(f['sigma'])} m, mass points as measured {_number(f['noise'])} m, spread of normalised "
        f"residuals {_number(f['spread'])}"
    )
    facts["gross errors"] = f["gross"]
    if f["suspects"]:
        facts["suspects"] = f["suspects"]
    if f["inputs"]:
        facts["inputs"] = [str(item.get("file", item)) for item in f["inputs"]]
    if f["settings"]:
        facts["settings"] = [f"{key} = {'auto' if value is None else value}" for key, value in f["settings"].items()]
    facts["layers"] = ", ".join(f["layers"])
    return facts


def model_figures(reader: ModelReader) -> dict[str, Any]:
    """Return figures of a terrain model as plain values; None where there is none.

    Length, signal, noise, sigma and spread are the whole model's, as the build told them. A model without these has
    medians (of lengths) and root mean squares over its units that are not empty, each unit counted once.
    """
    header, layout = reader.header, reader.layout
    units = [u for u in reader.figures() if u.meshes > 0]
    widths = Counter(u.meshes for u in units)
    there = np.isfinite(reader.ranges[..., 0])
    heights = [float(reader.ranges[there][:, 0].min()), float(reader.ranges[there][:, 1].max())] if there.any() else []
    return {
        "model": str(reader.path),
        "made_by": header.made_by,
        "identity": header.identity,
        "crs": header.crs,
        "height_system": header.height_system,
        "bounds": list(layout.bounds),
        "heights": heights or [None, None],
        "side": layout.side,
        "columns": layout.columns,
        "rows": layout.rows,
        "units": int(there.sum()),
        "empty": int((~there).sum()),
        "widths": [{"width": layout.side / n, "units": widths[n]} for n in sorted(widths)],
        "posts": sum(count * (n + 1) ** 2 for n, count in widths.items()),
        "points": sum(u.points for u in units),
        "lines": _line_counts(reader.lines()),
        "gross": len(reader.gross()),
        "suspects": len(reader.suspects()),
        "family": header.family,
        **_accuracy(header.totals, units),
        "totals": dict(header.totals),
        "settings": dict(header.settings),
        "inputs": [dict(item) for item in header.inputs],
        "layers": reader.layers(),
    }


def _accuracy(totals: Mapping[str, Any], units: list[UnitFigures]) -> dict[str, float | None]:
    if "spread" in totals:
        told = {name: totals[name] for name in ("length", "noise", "sigma", "spread")}
        return {"signal": float(np.sqrt(totals["variance"])), **told}
    return {
        "length": _median([u.length for u in units]),
        "signal": _rms([np.sqrt(u.variance) for u in units if u.variance >= 0]),
        "noise": _rms([u.noise for u in units]),
        "sigma": _rms([u.sigma for u in units]),
        "spread": _spread(units),
    }


def _line_counts(lines: list[LineElement]) -> dict[str, int]:
    counts = Counter(line.kind for line in lines)
    walls = sum(line.right is not None for line in lines)
    vertices = sum(len(line.xyz) for line in lines)
    return {**{str(k): counts[k] for k in sorted(counts)}, "two-sided": walls, "vertices": vertices}


def _lines_in_words(counts: dict[str, int]) -> str:
    kinds = [
        f"{n} {kind}{'s' if n != 1 else ''}" for kind, n in counts.items() if kind not in ("two-sided", "vertices")
    ]
    if not kinds:
        return "none"
    walls = f", {counts['two-sided']} of them two-sided" if counts["two-sided"] else ""
    return f"{', '.join(kinds)}{walls}; {counts['vertices']} vertices"


def _median(values: list[float]) -> float | None:
    good = [v for v in values if np.isfinite(v)]
    return float(np.median(good)) if good else None


def _rms(values: list[float]) -> float | None:
    good = np.array([v for v in values if np.isfinite(v)])
    return float(np.sqrt((good**2).mean())) if good.size else None


def _spread(units: list[UnitFigures]) -> float | None:
    """Return the spread over all units, each weighted with its points."""
    good = [(u.points, u.spread) for u in units if np.isfinite(u.spread) and u.points > 0]
    if not good:
        return None
    points, spread = np.array(good, float).T
    return float(np.sqrt((points * spread**2).sum() / points.sum()))


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


@dataclass(frozen=True)
class TerrainFacts(Result):
    """Facts of a terrain file."""

    facts: dict[str, Any]
    """In words, by name; lists have a line each."""
    figures: dict[str, Any]
    """Plain values, as JSON takes them."""
    gross: list[dict[str, Any]]
    """Measurements flagged as gross errors, the largest normalised residual first."""
    suspects: list[dict[str, Any]]
    """Measurements that are used, but look like parts of gross errors."""
    listed: bool = False
    """Show the flagged measurements."""

    def json_fields(self) -> dict[str, Any]:
        """Figures, and the flagged measurements if they are shown."""
        return self.figures | ({"gross_errors": self.gross, "suspect_points": self.suspects} if self.listed else {})

    def summary(self) -> Sequence[str]:
        """Return a line for each fact, and for each flagged measurement if they are shown."""
        width, lines = max(len(key) for key in self.facts), []
        for key, value in self.facts.items():
            for i, text in enumerate(value if isinstance(value, list) else [value]):
                lines.append(f"{key if i == 0 else '':<{width}}  {text}")
        flagged = [("", g) for g in self.gross] + [("suspect: ", g) for g in self.suspects]
        return lines + [
            f"{what}{g['name']}  {g['kind']}  X {g['x']:.3f} Y {g['y']:.3f} Z {g['z']:.3f}  "
            f"residual {g['residual']:+.3f} m ({g['normalised']:+.1f} σ, redundancy {g['redundancy']:.2f})"
            for what, g in flagged
            if self.listed
        ]


def describe_terrain(request: InfoRequest, events: Events = SILENT) -> TerrainFacts:
    """Describe a terrain model or a raster of heights; see `dtm_info`."""
    return replace(dtm_info(request.model), listed=request.gross)


def dtm_info(path: Path) -> TerrainFacts:
    """Describe a terrain model or a raster of heights.

    Raises
    ------
    InputError
        The file is missing, damaged or no terrain.
    """
    if not is_terrain_model(path):
        if path.is_file() and path.suffix.lower() in (".gpkg", ".toml", ".json"):
            raise InputError(f"{path}: no terrain model; `photoplan info` shows other files")
        facts = describe(path)
        return TerrainFacts(facts, facts, [], [])
    reader = ModelReader(path)
    gross = [_flagged(g) for g in sorted(reader.gross(), key=lambda g: -abs(g.normalised))]
    suspects = [_flagged(g) for g in reader.suspects()]
    return TerrainFacts(describe_model(reader), model_figures(reader), gross, suspects)


def _flagged(g: GrossError) -> dict[str, Any]:
    x, y, z = g.xyz
    return {"x": x, "y": y, "z": z, **pick(g, "name", "kind", "residual", "redundancy", "normalised")}


#: Lines of a table and letters of a line that are printed.
_MOST_LINES, _MOST_LETTERS = 24, 160
#: A table of larger numbers without a header holds coordinates.
_LARGEST_WEIGHT = 1000.0
#: Readers of TOML files that are neither projects nor cameras nor filters.
_TOMLS: dict[str, Callable[[Path], Any]] = {
    "balance": read_balance_file,
    "fall-off": read_fall_off_entry,
    "chromatic displacements": read_chromatic,
    "sensor": read_sensor,
    "series": read_series,
    "corrections of a line camera": read_line_correction,
    "image formation": lambda path: stated_model(path, None, None),
}


def _filter(path: Path) -> dict[str, Any]:
    if max(float(np.abs(kernel.values).max()) for kernel in load_filter(path).kernels) > _LARGEST_WEIGHT:
        raise InputError(f"{path}: not a filter but a table of numbers")
    return describe_filter(path)


def _mtf(path: Path) -> dict[str, Any]:
    read_mtf_table(path)
    return {"modulation transfer": str(path)}


#: Readers of texts without a mark of their own, in the order in which they are tried.
_TEXTS = (
    _filter,
    _control_list,
    _oriented,
    _cameras,
    _image_points,
    _ground_points,
    _positions,
    _mtf,
    _measured,
    _vectors,
)
_READERS: dict[str, Sequence[Callable[[Path], dict[str, Any]]]] = {
    ".json": (_oriented, _cameras, _objects, _vectors),
    ".xml": (_oriented, _cameras, _measured),
    ".yaml": (_cameras,),
    ".yml": (_cameras,),
    ".cam": (_cameras,),
    ".bin": (_oriented, _cameras),
    ".obj": (_objects,),
    ".ply": (_objects,),
    ".las": (_measured,),
    ".laz": (_measured,),
    ".jsonl": (_objects,),
    ".city.json": (_objects,),
    ".geojson": (_vectors,),
    ".shp": (_vectors,),
    ".dxf": (_vectors,),
    ".fgb": (_vectors,),
    ".kml": (_vectors,),
}
