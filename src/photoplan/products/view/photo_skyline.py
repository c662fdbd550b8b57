"""The skyline of a photograph against that of the terrain: how far apart they are, and what turn joins them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.robust import spread
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.geometry.rotation import small_rotations
from photoplan.io.quicklook import write_png
from photoplan.io.raster import RasterReader
from photoplan.io.tables import Columns, read_table
from photoplan.matching.grey import GreyImage
from photoplan.matching.sky_edge import edge_strength, sky_edge
from photoplan.orientation.skyline import SkylineFit, fit_skyline
from photoplan.products.view.camera import ViewCamera
from photoplan.products.view.content import grey_span, in_colours
from photoplan.products.view.lines import LineStyle
from photoplan.products.view.overlay import Overlay, OverlayFacts
from photoplan.products.view.photo import PhotoRequest, ViewPhoto
from photoplan.surfaces.seen import Seen
from photoplan.targets.view import FrameBundle, ViewTarget

_Floats = NDArray[np.float64]
#: From a target and columns beyond its picture to its skyline.
Finder = Callable[[ViewTarget, int], Seen]

#: How far the edge is looked for, and how far beyond the picture a skyline is for a turn, parts of the picture's sides.
_SEARCH, _BEYOND = 0.1, 0.1
#: Rounds of finding edge and skyline anew, and the step of both after which there is no more to do, pixels.
_ROUNDS, _DONE = 6, 0.01
#: Colours of the skyline of the terrain and of the edge in the photograph.
_OF_TERRAIN, _OF_PHOTO = (230, 60, 0), (0, 90, 200)


@dataclass(frozen=True)
class PhotoSkylineRequest:
    """What is asked of a photograph."""

    photo: Path
    """It has the pixels of the picture."""
    border: int = 0
    """Pixels along its edges that are no picture."""
    search: int | None = None
    """Rows above and below the skyline of the terrain where the edge is looked for; None: a tenth of the height."""
    control: Path | None = None
    """A table of points in the photograph and on the ground: x, y, E, N, H, name."""
    picture: Path | None = None
    """The photograph with both lines, PNG."""
    refine: bool = False
    """Whether the camera is turned until both agree."""
    focal: bool = False
    """Whether its camera constant changes, too."""
    refined: Path | None = None
    """A TOML file for the camera found: a standpoint's camera, or the orientation of an image."""

    def __post_init__(self) -> None:
        for name in ("focal", "refined"):
            if getattr(self, name) and not self.refine:
                raise UsageError(f"`{name}` belongs to a camera that is turned; say `refine`, too")
        if self.border < 0 or (self.search is not None and self.search < 2):
            raise UsageError(f"`border` {self.border}, `search` {self.search}; pixels from 0 and from 2 are needed")
        for path, suffix in ((self.picture, ".png"), (self.refined, ".toml")):
            if path is not None and path.suffix.lower() != suffix:
                raise UsageError(f"{path}: is written as {suffix}")


@dataclass(frozen=True)
class ControlResidual:
    """A point of control in the photograph."""

    name: str
    x: float
    y: float
    """Measured, pixels."""
    dx: float
    dy: float
    """Measured minus where the camera sees the ground point, pixels; NaN: behind the camera."""


@dataclass(frozen=True, eq=False)
class PhotoMatch:
    """A photograph beside the terrain."""

    edge: _Floats
    """Row of the sky's edge in each column of the photograph; NaN: none was found, shape (width,)."""
    residuals: _Floats
    """Edge minus skyline of the terrain at the points of this, (n,), rows; NaN: no edge."""
    control: tuple[ControlResidual, ...]
    target: ViewTarget
    line: Seen
    """The skyline of the terrain."""
    fit: SkylineFit | None = None
    """The turn; None: none was asked for."""
    turn: _Floats | None = None
    """All of it, by `orientation.skyline.UNKNOWNS`, (3,) or (4,)."""
    doubt: str | None = None
    """What speaks against the turn; None: nothing."""

    @property
    def figures(self) -> dict[str, Any]:
        """Columns compared, median and median absolute residual and robust spread, rows; control, pixels."""
        found = self.residuals[np.isfinite(self.residuals)]
        out: dict[str, Any] = {"columns_compared": len(found)}
        if len(found):
            out |= {
                "median_px": float(np.median(found)),
                "median_distance_px": float(np.median(np.abs(found))),
                "spread_px": spread(found, None),
            }
        if self.control:
            both = np.array([(c.dx, c.dy) for c in self.control])
            out["control_points"] = len(both)
            out["control_rms_px"] = float(np.sqrt(np.nanmean(both**2)))
        return out


def against_photo(
    request: PhotoSkylineRequest, camera: ViewCamera, find: Finder
) -> tuple[PhotoMatch, PhotoMatch | None]:
    """Both lines with the camera as it is, and with the one that the skyline asks for; None: that was not asked for."""
    target, size = camera.target, camera.target.bundle.size
    if camera.request.exaggeration != 1.0:
        raise UsageError("a photograph shows heights as they are; leave `exaggeration` away")
    reader = ViewPhoto.open(PhotoRequest(str(request.photo)), size).reader
    control = None if request.control is None else _control(request.control)
    search = max(2, round(_SEARCH * size[1])) if request.search is None else request.search
    first = _matched(request, reader, control, target, find(target, 0), search)
    if not request.refine:
        return first, None
    if not isinstance(target.bundle, FrameBundle):
        raise UsageError("a panorama is not turned onto a photograph; give a plane picture")
    turn, now, beyond = np.zeros(4 if request.focal else 3), target, round(_BEYOND * max(size))
    edge, found = first.edge, None
    for _ in range(_ROUNDS):
        found = _turn(target, turn, find(now, beyond), edge)
        turn, now = turn + found.step, turned(target, turn + found.step)
        if _moved(target, found.step) < _DONE:
            break
        edge = _edge(request, reader, find(now, 0), search)
    match = _matched(request, reader, control, now, find(now, 0), search)
    return first, replace(match, fit=found, turn=turn, doubt=doubt(target, now, match.line.XYZ, search))


def doubt(stated: ViewTarget, now: ViewTarget, XYZ: _Floats, search: int) -> str | None:
    """Of a camera whose skyline XYZ (n, 3) went round by round to an edge beyond `search` rows; None: it did not."""
    rows = np.abs(now.to_view(XYZ)[:, 1] - stated.to_view(XYZ)[:, 1])
    if not np.nanmedian(rows) > search:
        return None
    return (
        f"the turn moves the skyline by {np.nanmedian(rows):.0f} rows, though its edge was looked for within {search}: "
        "is it this standpoint, and does the photograph show this skyline?"
    )


def _turn(target: ViewTarget, turn: _Floats, line: Seen, edge: _Floats) -> SkylineFit:
    """What is to be added to a turn so that a skyline, found with it, lies on the edge."""

    def pixels(step: _Floats) -> _Floats:
        return turned(target, turn + step).to_view(line.XYZ)[:, :2]

    return fit_skyline(pixels, turned(target, turn).distance(line.uvh), edge, len(turn))


def turned(target: ViewTarget, step: _Floats) -> ViewTarget:
    """A plane picture's target whose camera is turned about its own axes, see `orientation.skyline.UNKNOWNS`."""
    assert isinstance(target.bundle, FrameBundle)
    longer = float(np.exp(step[3])) if len(step) > 3 else 1.0
    camera = target.bundle.camera.turned(small_rotations(step[None, :3])[0], longer)
    return replace(target, bundle=FrameBundle(camera))


def _moved(target: ViewTarget, step: _Floats) -> float:
    """By how much a turn moves the middle and the corners of a picture at most, nearly, pixels."""
    width, height = target.bundle.size
    corners = np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)], float)
    places = target.bundle.center + target.bundle.directions(np.vstack([corners, corners.mean(axis=0)]))
    moved = turned(target, step).bundle.pixels(places) - target.bundle.pixels(places)
    return float(np.nanmax(np.abs(moved[:, :2])))


def _control(path: Path) -> tuple[list[str], _Floats, _Floats]:
    """Names, places in the photograph (n, 2) and on the ground (n, 3) of a table."""
    roles = {
        "x": ("x", "column"),
        "y": ("y", "row"),
        "E": ("e", "east", "easting"),
        "N": ("n", "north", "northing"),
        "H": ("h", "height", "z"),
        "name": ("name", "id", "point"),
    }
    table = read_table(path, Columns(roles=roles, needed=("x", "y", "E", "N", "H"), row="point"))
    return list(table.labels("name", "line {line}")), table.numbers("x", "y"), table.numbers("E", "N", "H")


def _matched(
    request: PhotoSkylineRequest, reader: RasterReader, control: Any, target: ViewTarget, line: Seen, search: int
) -> PhotoMatch:
    edge = _edge(request, reader, line, search)
    residuals = edge[line.uvh[:, 0].astype(int)] - line.uvh[:, 1]
    points: tuple[ControlResidual, ...] = ()
    if control is not None:
        names, xy, XYZ = control
        off = (xy - target.to_view(XYZ)[:, :2]).tolist()
        points = tuple(ControlResidual(n, *at, *d) for n, at, d in zip(names, xy.tolist(), off))
    return PhotoMatch(edge=edge, residuals=residuals, control=points, target=target, line=line)


def _edge(request: PhotoSkylineRequest, reader: RasterReader, line: Seen, search: int) -> _Floats:
    """Rows of the sky's edge around a skyline, shape (width,)."""
    width, height = reader.size
    x, y = line.uvh[:, 0].astype(int), line.uvh[:, 1]
    if not len(x):
        return np.full(width, np.nan)
    low, high = np.ones(width, int), np.zeros(width, int)
    low[x] = np.clip(np.floor(y) - search, request.border, None)
    high[x] = np.clip(np.ceil(y) + search, None, height - 1 - request.border)
    low[: request.border], high[: request.border] = 1, 0
    low[width - request.border :], high[width - request.border :] = 1, 0
    used = low <= high
    if not used.any():
        return np.full(width, np.nan)
    top, bottom = int(low[used].min()), int(high[used].max()) + 1
    b = request.border
    grey = GreyImage(reader, (b, b, width - 1 - b, height - 1 - b)).read(Window(0, top, width, bottom - top))
    return sky_edge(edge_strength(grey), low - top, high - top) + top


def draw_match(path: Path, photo: Path, match: PhotoMatch) -> None:
    """The photograph with the skyline of the terrain and the edge in it, and its control, as a PNG."""
    reader = RasterReader(photo)
    window = Window(0, 0, *reader.size)
    picture = np.clip(np.rint(in_colours(reader.read(window)[0], grey_span(reader))), 0, 255).astype(np.uint8)
    thick = max(1.5, max(reader.size) / 700)
    at = np.array([(c.x, c.y, c.x - c.dx, c.y - c.dy) for c in match.control]).reshape(-1, 4)
    at = at[np.isfinite(at).all(axis=1)]
    strokes = (
        (LineStyle(_OF_TERRAIN, thick), _segments(match.line.uvh[:, :2])),
        (LineStyle(_OF_PHOTO, thick), _segments(np.column_stack([np.arange(len(match.edge)), match.edge]))),
        (LineStyle(_OF_TERRAIN, thick), at),
        (LineStyle(_OF_PHOTO, 4 * thick), at[:, [0, 1, 0, 1]]),
    )
    Overlay(
        size=reader.size, strokes=strokes, layers=(), labels=(), text_size=0.0, facts=OverlayFacts(0, 0, 0, 0)
    ).paint(picture, window)
    write_png(path, np.concatenate([picture, np.full((1, *picture.shape[1:]), 255, np.uint8)]))


def _segments(line: _Floats) -> _Floats:
    """Both ends of what lies between neighbouring columns, shape (n, 4)."""
    ends = np.concatenate([line[:-1], line[1:]], axis=1)
    return np.ascontiguousarray(ends[np.isfinite(ends).all(axis=1) & (ends[:, 2] - ends[:, 0] < 1.5)])
