"""Photographs as views: their content, orientation by skylines."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import by_differences, spread
from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.geometry.pose import angle_in_unit, angles_from_rotation, small_rotations, view_from_rotation
from photoplan.io.orientation.block import OrientationBlock, OrientationTable, OrientedImage
from photoplan.io.orientation.text import render_toml
from photoplan.io.product import write_png
from photoplan.io.project.file import toml_value
from photoplan.io.raster import RasterReader
from photoplan.io.store import write_atomically
from photoplan.io.tables import Columns, read_table
from photoplan.matching.features import GreyImage, edge_strength, sky_edge
from photoplan.orientation.intersection import SkylineFit, fit_skyline
from photoplan.products.view.camera import ViewCamera, ViewGround, map_axes
from photoplan.products.view.content import Colours, Overlay, OverlayFacts, grey_span, in_colours
from photoplan.products.view.lines import LineStyle
from photoplan.project.cameras import stated_pose
from photoplan.requests.view import CameraRequest, PhotoRequest, SkylineRequest
from photoplan.surfaces.seen import Seen
from photoplan.targets.view import FrameBundle, ViewTarget

#: Squares along the longer side of a picture.
_SQUARES = 16


@dataclass(frozen=True, eq=False)
class ViewPhoto:
    """A photograph, open, and the size of the picture that it belongs to."""

    request: PhotoRequest
    reader: RasterReader
    span: tuple[float, float]
    """Values that become black and white."""

    @classmethod
    def open(cls, request: PhotoRequest, size: tuple[int, int]) -> ViewPhoto:
        """"""
        reader = RasterReader(Path(request.path))
        if reader.size != size:
            own, asked = (" × ".join(map(str, each)) for each in (reader.size, size))
            raise InputError(
                f"{request.path}: {own} pixels, the picture has {asked}; give the photo's own image as `camera`, or "
                "its `size`"
            )
        return cls(request, reader, grey_span(reader))

    @property
    def shift(self) -> int:
        """Columns by which the photo lies beside the picture; 0: over it."""
        return self.reader.size[0] if self.request.how == "beside" else 0

    def lay(self, picture: NDArray[np.uint8], window: Window) -> None:
        """Put its pixels into those of a window of the product, shape (3, height, width)."""
        width, height = self.reader.size
        place = Window(self.shift, 0, width, height) & window
        if not place.size:
            return
        own = Window(place.col - self.shift, place.row, place.width, place.height)
        values, valid = self.reader.read(own)
        colours: Colours = in_colours(values, self.span)
        weight = np.full(colours.shape[1:], self.request.opacity if self.request.how == "over" else 1.0, np.float32)
        if self.request.how == "squares":
            v, u = np.mgrid[own.row : own.stop[1], own.col : own.stop[0]] // max(1, -(-max(width, height) // _SQUARES))
            weight[(u + v) % 2 == 0] = 0.0
        if valid is not None:
            weight[~valid] = 0.0
        at = (slice(None), *place.slices(window))
        under = picture[at].astype(np.float32) if not self.shift else np.zeros_like(colours)
        picture[at] = np.clip(np.rint(under + weight * (colours - under)), 0, 255)


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
    """Sentence that speaks against the turn; None if nothing does."""

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


def against_photo(request: SkylineRequest, camera: ViewCamera, find: Finder) -> tuple[PhotoMatch, PhotoMatch | None]:
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
    """Return a doubt if the skyline XYZ (n, 3) of a camera went round by round to an edge beyond `search` rows."""
    rows = np.abs(now.to_view(XYZ)[:, 1] - stated.to_view(XYZ)[:, 1])
    if not np.nanmedian(rows) > search:
        return None
    return (
        f"the turn moves the skyline by {np.nanmedian(rows):.0f} rows, though its edge was looked for within {search}: "
        "is it this standpoint, and does the photograph show this skyline?"
    )


def _turn(target: ViewTarget, turn: _Floats, line: Seen, edge: _Floats) -> SkylineFit:
    """Return what is to be added to a turn so that a skyline, found with it, lies on the edge."""

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
    """Return by how much a turn moves the middle and the corners of a picture at most, nearly, pixels."""
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
    request: SkylineRequest, reader: RasterReader, control: Any, target: ViewTarget, line: Seen, search: int
) -> PhotoMatch:
    edge = _edge(request, reader, line, search)
    residuals = edge[line.uvh[:, 0].astype(int)] - line.uvh[:, 1]
    points: tuple[ControlResidual, ...] = ()
    if control is not None:
        names, xy, XYZ = control
        off = (xy - target.to_view(XYZ)[:, :2]).tolist()
        points = tuple(ControlResidual(n, *at, *d) for n, at, d in zip(names, xy.tolist(), off))
    return PhotoMatch(edge=edge, residuals=residuals, control=points, target=target, line=line)


def _edge(request: SkylineRequest, reader: RasterReader, line: Seen, search: int) -> _Floats:
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


@dataclass(frozen=True)
class RefinedCamera:
    """A camera, turned; its standpoint is as it was."""

    names: tuple[str, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    sigma: tuple[float, ...]
    unit: str
    """Unit of all of them: deg, gon or rad."""
    used: int
    """Columns of the photograph that decided."""
    correlated: float
    """Columns that err together, see `orientation.skyline`."""
    text: str
    """The file that holds it."""
    constant: tuple[float, float] | None = None
    """Factor of an image's camera constant, if it was free, and its standard deviation."""

    def json_fields(self) -> dict[str, Any]:
        """Its numbers."""
        rows = zip(self.names, self.before, self.after, self.sigma)
        told = {name: {"before": b, "after": a, "sigma": s} for name, b, a, s in rows}
        if self.constant is not None:
            told["constant_factor"] = {"before": 1.0, "after": self.constant[0], "sigma": self.constant[1]}
        return {"unit": self.unit, **told, "columns_used": self.used, "columns_correlated": self.correlated}


def refined_camera(camera: ViewCamera, match: PhotoMatch, ground: ViewGround, path: Path | None) -> RefinedCamera:
    """Angles of a camera that was turned: azimuth, pitch, roll and field of view of a standpoint, an image's own."""
    assert match.fit is not None and match.turn is not None
    of_image = camera.request.image is not None

    def numbers(turn: _Floats) -> _Floats:
        return _of_image(camera, ground, turn) if of_image else _of_standpoint(camera, turn)

    unit = ground.named.orientation.angle_unit if of_image else "deg"
    order = ground.named.orientation.rotation if of_image else ""
    greek = {"o": "omega", "p": "phi", "k": "kappa"}
    names = tuple(greek[k] for k in order) if of_image else ("azimuth", "pitch", "roll", "field_of_view")
    before, after = numbers(np.zeros_like(match.turn)), numbers(match.turn)
    D = by_differences(numbers, match.turn, 1e-6)
    sigma = np.sqrt(np.diag(D @ match.fit.covariance @ D.T))
    count = len(names) if of_image else len(match.turn)
    constant = None
    if of_image and len(match.turn) > 3:
        factor = math.exp(match.turn[3])
        constant = factor, factor * math.sqrt(match.fit.covariance[3, 3])
    if of_image:
        text = _orientation_text(camera, ground, after, path, constant)
    else:
        text = _camera_text(camera.request, after)
    told = (tuple(float(v) for v in row[:count]) for row in (before, after, sigma))
    b, a, s = told
    return RefinedCamera(
        names=names[:count],
        before=b,
        after=a,
        sigma=s,
        unit=unit,
        used=match.fit.used,
        correlated=match.fit.correlated,
        text=text,
        constant=constant,
    )


def write_refined(path: Path, refined: RefinedCamera) -> None:
    """Write its file."""
    write_atomically(path, refined.text.encode())


def _of_standpoint(camera: ViewCamera, turn: _Floats) -> _Floats:
    """Azimuth, pitch, roll and field of view, degrees."""
    target = turned(camera.target, turn)
    assert isinstance(target.bundle, FrameBundle)
    axes = map_axes(target.warps, target.center)
    azimuth, pitch, roll = view_from_rotation(axes.T @ target.bundle.camera.pose.R_ground_camera)
    stated = math.radians(camera.request.azimuth or 0.0)
    azimuth = stated + math.remainder(azimuth - stated, 2 * math.pi)
    half = math.tan(math.radians(camera.request.field_of_view or 60.0) / 2)
    wide = 2 * math.atan(half / math.exp(turn[3] if len(turn) > 3 else 0.0))
    return np.degrees([azimuth, pitch, roll, wide])


def _of_image(camera: ViewCamera, ground: ViewGround, turn: _Floats) -> _Floats:
    """Angles of an image, in the order and the unit of its project."""
    project = ground.named
    R = stated_pose(project, project.image(str(camera.request.image))).R_ground_camera
    angles = angles_from_rotation(R @ small_rotations(turn[None, :3])[0], project.orientation.rotation)
    return angle_in_unit(angles, project.orientation.angle_unit)


def _camera_text(request: CameraRequest, after: _Floats) -> str:
    """A file that is taken in place of an image as the camera of a view."""
    names = ("azimuth", "pitch", "roll", "field_of_view")
    values: dict[str, Any] = dict(zip(names, (round(float(v), 7) for v in after)))
    found = request.replace(**values)
    lines = ["# A camera of views, turned onto the skyline of a photograph; angles in degrees, lengths in metres."]
    told = ((n, list(v) if isinstance(v, tuple) else v) for n, v in found.json_fields().items() if v is not None)
    return "\n".join([*lines, *(f"{n} = {toml_value(v)}" for n, v in told), ""])


def _orientation_text(
    camera: ViewCamera, ground: ViewGround, after: _Floats, path: Path | None, constant: tuple[float, float] | None
) -> str:
    """An orientation file of one image."""
    project = ground.named
    image = project.image(str(camera.request.image))
    a, b, c = (round(float(v), 8) for v in after)
    line = OrientedImage(name=image.name, center=image.pose_numbers[0], angles=(a, b, c), camera=image.camera)
    stated = project.orientation
    file = path or Path("refined.toml")
    table = OrientationTable(
        file, (line,), stated.angle_unit, stated.rotation, crs=project.crs, height_system=stated.height_system
    )
    note = ""
    if constant is not None:
        factor, sigma = constant
        note = f"# Its camera constant is {factor:.7f} (±{sigma:.7f}) times that of its camera: alter it there, too.\n"
    return note + render_toml(OrientationBlock(table), file)[file]
