"""Lines and paths in perspective views."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError, named_by
from photoplan.geometry.crs import canonical_crs, crs_label, crs_step, same_crs
from photoplan.geometry.units import MetricSystem, agreed_metres, metric_system
from photoplan.io.tables import Columns, read_table
from photoplan.io.vector_layer import DrawnFeatures, read_drawn_features
from photoplan.products.dtm.lines import contour_parts
from photoplan.products.view.camera import ViewGround
from photoplan.project.ground import open_terrain
from photoplan.requests.view import CameraRequest, LinesRequest, number_in
from photoplan.surfaces.seen import Lines
from photoplan.terrain.contours import trace_contours
from photoplan.terrain.shading import ContourOptions

T = TypeVar("T")
Colour = tuple[int, int, int]
NAMES: dict[str, Colour] = {
    "black": (0, 0, 0), "white": (255, 255, 255), "grey": (128, 128, 128), "red": (213, 94, 0), "blue": (0, 114, 178),
    "green": (0, 158, 115), "yellow": (240, 228, 66), "orange": (230, 159, 0), "purple": (204, 121, 167),
    "sky": (86, 180, 233), "brown": (122, 74, 30),
}  # fmt: skip
#: Widths, dashes and sizes of marks, pixels.
_WIDEST = 200.0
#: Vertices that one layer may have.
_MOST = 5_000_000


@dataclass(frozen=True)
class LineStyle:
    """Look of a line; the width of a point is the diameter of its mark."""

    colour: Colour
    width: float
    """Pixels."""
    dash: tuple[float, ...] = ()
    """Lengths of strokes and gaps, pixels."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Lines and points that are drawn, on the map of the ground."""

    styles: tuple[LineStyle, ...]
    lines: Lines
    style: NDArray[np.int64]
    """Style of each line."""
    points: NDArray[np.float64]
    """Shape (k, 3); NaN height: on the ground."""
    point_style: NDArray[np.int64]
    labels: tuple[str, ...]
    """Labels of the points; ``{H}`` and ``{distance}`` in them stand for numbers that the view knows."""
    rank: NDArray[np.float64]
    """Ranks of the points; labels of lower ranks come first, NaN by height."""


def open_drawing(requests: Sequence[LinesRequest], ground: ViewGround, reach: float, center: Any) -> Drawing:
    """All layers, one after the other."""
    made = [
        _contours(each, ground, reach, np.asarray(center)) if each.path is None else _features(each, ground)
        for each in requests
    ]
    styles, lines, shift = [], [], 0
    for each in made:
        lines.append(each.lines.line + shift)
        shift += len(each.style)
        styles.append(len(each.styles))
    first = np.cumsum(styles) - styles
    return Drawing(
        styles=tuple(s for each in made for s in each.styles),
        lines=Lines(np.concatenate([each.lines.XYZ for each in made]), np.concatenate(lines)),
        style=np.concatenate([each.style + k for each, k in zip(made, first)]),
        points=np.concatenate([each.points for each in made]),
        point_style=np.concatenate([each.point_style + k for each, k in zip(made, first)]),
        labels=tuple(label for each in made for label in each.labels),
        rank=np.concatenate([each.rank for each in made]),
    )


def _contours(request: LinesRequest, ground: ViewGround, reach: float, center: NDArray[np.float64]) -> Drawing:
    project, path, crs = ground.project, ground.files[0], ground.crs
    if project is not None:
        if project.ground.file is None:
            raise UsageError("contours of a project whose ground has one height everywhere; leave them out")
        path, crs = project.resolve(project.ground.file), project.ground.crs or ground.crs
    terrain = open_terrain(path, default_crs=crs)
    XY = center[:2]
    if not same_crs(terrain.crs, ground.crs):
        XY = crs_step(ground.crs, terrain.crs, ground.bounds)(XY)
    bounds = (float(XY[0] - reach), float(XY[1] - reach), float(XY[0] + reach), float(XY[1] + reach))
    levels = ContourOptions(interval=request.interval)
    vertices: list[NDArray[np.float64]] = []
    index: list[bool] = []
    for line in trace_contours(contour_parts(terrain, levels, bounds)[0], levels):
        vertices.append(line.xy)
        index.append(line.index)
        if sum(map(len, vertices[-1000:])) * max(1, len(vertices) // 1000) > _MOST:
            raise UsageError(f"contours every {request.interval:g} m: too many; give a larger interval or `farthest`")
    XY = np.concatenate([np.empty((0, 2)), *vertices])
    if not same_crs(terrain.crs, ground.crs):
        XY = crs_step(terrain.crs, ground.crs, terrain.bounds)(XY)
    options = dict(request.options)
    plain = LineStyle(
        _colour(options.get("colour", "brown"), "contours"),
        number_in(options.get("width", "0.8"), "contours: width", 0.1, _WIDEST),
        _dash(options.get("dash", ""), "contours"),
    )
    number = np.repeat(np.arange(len(vertices)), [len(xy) for xy in vertices])
    return Drawing(
        styles=(plain, replace(plain, width=2 * plain.width)),
        lines=Lines(np.column_stack([XY, np.full(len(XY), np.nan)]), number),
        style=np.array(index, np.int64),
        points=np.empty((0, 3)),
        point_style=np.empty(0, np.int64),
        labels=(),
        rank=np.empty(0),
    )


def _features(request: LinesRequest, ground: ViewGround) -> Drawing:
    assert request.path is not None
    table, options = read_drawn_features(request.path, request.layer), dict(request.options)
    if len(table.XYZ) > _MOST:
        raise InputError(f"{table.path}: {len(table.XYZ)} vertices; up to {_MOST} are drawn. Choose a part of it")
    XYZ = in_crs_of_ground(table, options, ground)
    values = _Values(table, options)
    point_vertex = table.is_point[table.part]
    is_line = np.flatnonzero(~table.is_point)
    number = np.cumsum(~table.is_point) - 1
    lines = Lines(XYZ[~point_vertex], number[table.part[~point_vertex]])
    looks: dict[LineStyle, int] = {}
    style = [looks.setdefault(values.style(row, "red", "1.5"), len(looks)) for row in table.row[is_line].tolist()]
    rows = table.row[table.is_point].tolist()
    marks = [looks.setdefault(values.style(row, "black", "5"), len(looks)) for row in rows]
    return Drawing(
        styles=tuple(looks),
        lines=lines,
        style=np.array(style, np.int64),
        points=XYZ[point_vertex],
        point_style=np.array(marks, np.int64),
        labels=tuple(values.label(row) for row in rows),
        rank=np.array([values.rank(row) for row in rows], float),
    )


def in_crs_of_ground(table: DrawnFeatures, options: dict[str, str], ground: ViewGround) -> NDArray[np.float64]:
    """Vertices in the CRS of the ground, in metres; heights are left out where all lies on the ground."""
    XYZ = table.XYZ.copy()
    drape = options.get("drape", "no")
    if drape not in ("yes", "no"):
        raise UsageError(f"{table.path}: drape={drape}; allowed are yes and no")
    if drape == "yes":
        XYZ[:, 2] = np.nan
    crs = options.get("crs", table.crs)
    suffix = table.path.suffix.lower()
    if crs is None and suffix in (".geojson", ".json") and np.abs(XYZ[:, :2]).max() <= 360:
        crs = "EPSG:4326"
    if crs is None and suffix != ".dxf":
        raise InputError(
            f"{table.path}: states no CRS, and it is not guessed; say crs={canonical_crs(ground.crs)} if it is that of "
            "the ground"
        )
    stated, known = table.height_system, ground.height_system
    system = MetricSystem(ground.crs, 1.0, None, 1.0) if crs is None else metric_system(crs, f"{table.path}: CRS")
    system = system.declaring(stated, f"{table.path}: heights")
    XYZ[:, :2] *= agreed_metres(table.unit, system.scale, f"{table.path}: X and Y", in_one_file=False)
    if not np.isnan(XYZ[:, 2]).all():
        XYZ[:, 2] *= agreed_metres(table.unit, system.height_scale, f"{table.path}: heights", in_one_file=False)
    crs, stated = crs and system.crs, stated and system.heights
    if not np.isnan(XYZ[:, 2]).all() and stated is not None and known is not None and not same_crs(stated, known):
        raise InputError(
            f"{table.path}: heights in {crs_label(stated)}, those of the ground are in {crs_label(known)}; convert "
            "them, or say drape=yes"
        )
    if crs is not None and not same_crs(crs, ground.crs):
        low, high = XYZ[:, :2].min(axis=0), XYZ[:, :2].max(axis=0)
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        with named_by(table.path):
            XYZ[:, :2] = crs_step(crs, ground.crs, bounds)(XYZ[:, :2])
    return XYZ


@dataclass(frozen=True, eq=False)
class _Values:
    """Values of style: of an attribute that the option names, of the option itself, or of an attribute of that name."""

    table: DrawnFeatures
    options: dict[str, str]

    def __post_init__(self) -> None:
        for key in ("label", "rank"):
            value = self.options.get(key, "")
            if value and value.casefold() not in self.table.fields:
                known = ", ".join(self.table.fields) or "none"
                raise InputError(f"{self.table.path}: {key}={value}: no such attribute; there are {known}")

    def style(self, row: int, colour: str, width: str) -> LineStyle:
        where = f"{self.table.path}: feature {row + 1}"
        return LineStyle(
            self._of("colour", row, colour, lambda text: _colour(text, where), "color"),
            self._of("width", row, width, lambda text: number_in(text, f"{where}: width", 0.1, _WIDEST)),
            self._of("dash", row, "", lambda text: _dash(text, where)),
        )

    def label(self, row: int) -> str:
        """Text of a point, empty: none."""
        text = self._of("label", row, "", str, "name")
        if text and self.options.get("height", "no") == "yes":
            text += " {H}"
        if text and self.options.get("distance", "no") == "yes":
            text += " · {distance}"
        return text

    def rank(self, row: int) -> float:
        """Lower ones come first."""
        name = self.options.get("rank", "").casefold()
        text = self._text(name, row) if name else ""
        if not text:
            return float("nan")
        return number_in(text, f"{self.table.path}: feature {row + 1}: rank", -1e12, 1e12)

    def _of(self, key: str, row: int, default: str, read: Callable[[str], T], also: str = "") -> T:
        stated = self.options.get(key)
        if stated is not None and stated.casefold() not in self.table.fields:
            return read(stated)
        names: Iterator[str] = iter((stated.casefold(),) if stated is not None else (key, also))
        text = next((t for t in (self._text(n, row) for n in names if n in self.table.fields) if t), "")
        return read(text or default)

    def _text(self, field: str, row: int) -> str:
        value = self.table.fields[field][row]
        if value is None or (isinstance(value, float | np.floating) and np.isnan(value)):
            return ""
        return " ".join(str(value).split())[:80]


def _colour(text: str, where: str) -> Colour:
    name = text.strip().casefold()
    if name in NAMES:
        return NAMES[name]
    if not re.fullmatch(r"#[0-9a-f]{6}", name):
        raise InputError(f"{where}: colour {text[:40]!r}; allowed are #rrggbb and {', '.join(NAMES)}")
    return int(name[1:3], 16), int(name[3:5], 16), int(name[5:7], 16)


def _dash(text: str, where: str) -> tuple[float, ...]:
    parts = [part for part in re.split(r"[-\s]+", text.strip()) if part]
    dash = tuple(number_in(part, f"{where}: dash", 0.1, _WIDEST) for part in parts)
    if len(dash) % 2:
        raise InputError(f"{where}: dash {text[:40]!r}; strokes and gaps in pixels are needed, such as 6-3")
    return dash


_Floats = NDArray[np.float64]
#: Pictures of a sequence at most.
MOST_FRAMES = 100_000


def stations(path: Path, layer: str | None, step: float | None, ground: ViewGround) -> _Floats:
    """Places (n, 3) along a path; NaN height: none is stated."""
    if path.suffix.lower() in (".csv", ".txt"):
        roles = {"x": ("x", "e", "east", "easting"), "y": ("y", "n", "north", "northing"), "z": ("z", "h", "height")}
        table = read_table(path, Columns(roles=roles, needed=("x", "y"), row="station"))
        places, line = np.column_stack([table.numbers("x", "y"), table.numbers("z", empty=True).ravel()]), False
    else:
        drawn = read_drawn_features(path, layer)
        line = not bool(drawn.is_point.all())
        if line and len(drawn.is_point) != 1:
            raise InputError(f"{path}: {len(drawn.is_point)} points and lines; a path is one line, or points alone")
        places = in_crs_of_ground(drawn, {}, ground)
    if line != (step is not None):
        raise UsageError(f"{path}: " + ("a line needs a `step`, metres" if line else "stations have no `step`"))
    if step is not None:
        places = at_equal_steps(places, step)
    if not 2 <= len(places) <= MOST_FRAMES:
        raise UsageError(f"{path}: {len(places)} stations; 2 to {MOST_FRAMES} are allowed")
    return places


def at_equal_steps(line: _Floats, step: float) -> _Floats:
    """Places (m, 3) on a line (n, 3) at equal steps on the map, from its first vertex on."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
    if not (math.isfinite(step) and step > 0) or along[-1] / step > MOST_FRAMES:
        raise UsageError(f"`step` {step} m along {along[-1]:.6g} m; at most {MOST_FRAMES} stations are allowed")
    at = np.arange(0.0, along[-1] * (1 + 1e-12), step)
    return np.column_stack([np.interp(at, along, line[:, k]) for k in range(3)])


def cameras(template: CameraRequest, places: _Floats, along: bool) -> list[CameraRequest]:
    """A camera at each of the places (n, 3); `along`: its azimuth is that from the station before to the one behind."""
    ahead = np.vstack([places[1:2] - places[:1], places[2:] - places[:-2], places[-1:] - places[-2:-1]])
    azimuth = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    for k in np.flatnonzero(np.hypot(ahead[:, 0], ahead[:, 1]) == 0).tolist():
        azimuth[k] = azimuth[k - 1] if k else 0.0
    out = []
    for (x, y, z), way in zip(places.tolist(), azimuth.tolist()):
        altitude = template.altitude if math.isnan(z) else z + template.height
        out.append(template.replace(position=(x, y), altitude=altitude, azimuth=way if along else template.azimuth))
    return out
