"""What a terrain model holds, in words and in figures."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from photoplan.geometry.crs import crs_label
from photoplan.geometry.heights import height_label
from photoplan.io.terrain.model_read import ModelReader
from photoplan.surfaces.units import LineElement, UnitFigures


def describe_model(reader: ModelReader) -> dict[str, Any]:
    """Facts of a terrain model by name, as texts; lists have a line each."""
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
    if f["inputs"]:
        facts["inputs"] = [str(item.get("file", item)) for item in f["inputs"]]
    if f["settings"]:
        facts["settings"] = [f"{key} = {'auto' if value is None else value}" for key, value in f["settings"].items()]
    facts["layers"] = ", ".join(f["layers"])
    return facts


def model_figures(reader: ModelReader) -> dict[str, Any]:
    """Figures of a terrain model as plain values; None where there is none.

    Lengths are medians and accuracies root mean squares over the units that are not empty, each unit counted once.
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
        "family": header.family,
        "length": _median([u.length for u in units]),
        "signal": _rms([np.sqrt(u.variance) for u in units if u.variance >= 0]),
        "noise": _rms([u.noise for u in units]),
        "sigma": _rms([u.sigma for u in units]),
        "spread": _spread(units),
        "totals": dict(header.totals),
        "settings": dict(header.settings),
        "inputs": [dict(item) for item in header.inputs],
        "layers": reader.layers(),
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
    """Spread over all units, each weighted with its points."""
    good = [(u.points, u.spread) for u in units if np.isfinite(u.spread) and u.points > 0]
    if not good:
        return None
    points, spread = np.array(good, float).T
    return float(np.sqrt((points * spread**2).sum() / points.sum()))


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"
