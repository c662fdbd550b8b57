"""What a terrain model's file says of itself: its header, its lists, and the names of its tables."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.io.fingerprint import fingerprint
from photoplan.plain import json_text
from photoplan.surfaces.units import UnitFigures, UnitLayout

FORMAT = 1
"""Number of the layout; a file with another one is refused."""
MOST_UNITS = 4_000_000
"""Computing units of a model at most."""

HEADER = "photoplan_terrain"
UNITS = "photoplan_terrain_units"
LINES = "photoplan_terrain_lines"


@dataclass(frozen=True)
class GrossError:
    """A measurement that was flagged: it contradicts its neighbours more than its accuracy allows."""

    name: str
    """How users find it: file, record, own name."""
    kind: str
    """Mass point, spot height, or the kind of its line."""
    xyz: tuple[float, float, float]
    """X, Y, Z as measured, metres."""
    residual: float
    """Measured height less that of the surface without this measurement, metres."""
    redundancy: float
    """Share of an error that shows in the residual, 0 to 1."""
    normalised: float
    """Residual in units of its own standard deviation."""


@dataclass(frozen=True)
class ModelHeader:
    """What identifies a terrain model."""

    crs: str
    """Projected CRS in metres, as pyproj reads it."""
    height_system: str | None
    """Vertical CRS or `ellipsoidal`; None: not stated."""
    layout: UnitLayout
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What the model was computed with; JSON values."""
    inputs: tuple[Mapping[str, Any], ...] = ()
    """Files that it was computed from, see `input_facts`."""
    family: str = ""
    """Family of the covariance functions, such as `gaussian`; empty: not predicted."""
    totals: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the whole model; JSON values."""
    made_by: str = ""
    """Program and version; set when the file is written."""
    identity: str = ""
    """Digest of all units; set when the file is written."""


def input_facts(path: Path) -> dict[str, Any]:
    """Name, size and digest of an input, for the header."""
    found = fingerprint(path)
    return {"file": Path(path).name, "bytes": found.size, "sha256_sampled": found.digest}


def empty_figures(column: int, row: int) -> UnitFigures:
    """Figures of a unit without a surface."""
    nan = math.nan
    return UnitFigures(
        column=column,
        row=row,
        meshes=0,
        low=nan,
        high=nan,
        points=0,
        lines=0,
        variance=nan,
        length=nan,
        noise=nan,
        sigma=nan,
        spread=nan,
        gross=0,
    )


def check_layout(layout: UnitLayout, where: str) -> None:
    """Refuse more units than can be handled."""
    if layout.columns * layout.rows > MOST_UNITS:
        raise InputError(
            f"{where}: {layout.columns} × {layout.rows} units; at most {MOST_UNITS} are allowed: take larger units"
        )


def header_to_json(header: ModelHeader) -> str:
    """The header as text."""
    return json_text(header, "header", indent=None)


def header_from_json(text: str, path: Path) -> ModelHeader:
    """The header of a file's text."""
    try:
        content = json.loads(text)
        place = content["layout"]
        left, top, side = (float(place[name]) for name in ("left", "top", "side"))
        layout = UnitLayout(left=left, top=top, side=side, columns=int(place["columns"]), rows=int(place["rows"]))
        check_layout(layout, str(path))
        header = ModelHeader(
            crs=content["crs"],
            height_system=content["height_system"],
            layout=layout,
            settings=dict(content["settings"]),
            inputs=tuple(dict(item) for item in content["inputs"]),
            family=content["family"],
            totals=dict(content["totals"]),
            made_by=content["made_by"],
            identity=content["identity"],
        )
    except InputError as error:
        raise InputError(f"{path}: header of the terrain model: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: header of the terrain model is damaged ({error!r}); get a fresh copy") from None
    texts = (header.crs, header.height_system or "", header.family, header.made_by, header.identity)
    if not all(isinstance(text, str) for text in texts) or not header.crs:
        raise InputError(f"{path}: header of the terrain model: no CRS, or no text where one is needed")
    return header
