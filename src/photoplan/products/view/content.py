"""Content of perspective views: rasters, photographs, overlays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from photoplan.cameras.base import CentralCamera, Projection
from photoplan.cameras.curvature import MapProjection
from photoplan.cameras.framed import taken_apart
from photoplan.engine.execute import Reader, Source, render
from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_label, crs_step, same_crs
from photoplan.geometry.grid import Window, level_size
from photoplan.io.raster import RasterReader, stated_classes
from photoplan.io.raster_info import placement_of
from photoplan.kernels.raster import draw_lines
from photoplan.plain import xml_quoted, xml_text
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Tile, Tiles
from photoplan.plan.ground import TileGround
from photoplan.plan.product import ProductPlan
from photoplan.plan.sources import Share
from photoplan.products.view.camera import ViewGround
from photoplan.products.view.lines import Drawing, LineStyle
from photoplan.project.scene import open_scene
from photoplan.requests.view import ContentRequest
from photoplan.surfaces.base import Surface
from photoplan.surfaces.seen import LIFT_OF_POINTS, LinesOfSight, Seen, SeenLines, SeenSurface, best_photos
from photoplan.targets.map import Target
from photoplan.targets.view import ViewTarget
from photoplan.terrain.shading import RAMPS, Lighting, Ramp, built_in_ramp, directions, shaded

#: Colours of slopes, at degrees.
SLOPES = Ramp(
    np.array([0.0, 10, 20, 30, 45]),
    np.array([(255, 255, 212), (254, 217, 142), (254, 153, 41), (204, 76, 2), (120, 30, 10)], float),
)
#: Longer sides of the reduced image from which the range of grey values is taken, pixels.
_LOOKED = 512
_PERCENT = (2.0, 98.0)
#: Part of the circle of hues between classes whose numbers follow each other: no two of many come near.
_GOLDEN = (5**0.5 - 1) / 2

Look = Callable[[Window], Seen]

Colours = NDArray[np.float32]
"""Red, green, blue, shape (3, height, width), 0 to 255."""


@dataclass(frozen=True, eq=False)
class ViewScene:
    """A part of a view before it has colours."""

    target: ViewTarget
    tile: Tile
    """Its window in the target."""
    seen: Seen
    """Shape (height, width, …)."""
    around: tuple[Window, NDArray[np.float32]]
    """The part with a pixel more all round, as far as the view goes, and the depth of its pixels."""
    surface: SeenSurface
    kernel: str
    tolerance: float = 0.02
    """See `AnchorRule`."""

    @classmethod
    def of(
        cls, target: ViewTarget, tile: Tile, look: Look, surface: SeenSurface, kernel: str, tolerance: float
    ) -> ViewScene:
        """Return what a part of a view shows; `look` finds it for a window."""
        window = tile.window
        around = Window(window.col - 1, window.row - 1, window.width + 2, window.height + 2) & target.window
        seen = look(around)
        depth = seen.uvh[..., 2].astype(np.float32)
        return cls(target, tile, seen.part(*window.slices(around)), (around, depth), surface, kernel, tolerance)

    def relief(self, target: Target, window: Window) -> NDArray[np.float32]:
        """Depth of pixels of the part: the engine need not look again."""
        around, depth = self.around
        return depth[window.slices(around)]


class ViewLayer(Protocol):
    """Source of colours for a part of a view."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that it reads."""
        ...

    def paint(self, scene: ViewScene, under: Colours) -> tuple[Colours, NDArray[np.bool_]]:
        """Colours with its own over those `under` it, and where it has any."""
        ...


@dataclass(frozen=True)
class Shade:
    """Light on the terrain: alone a hillshade, over other content it darkens and lightens that."""

    light: Lighting
    strength: float
    first: bool
    files: tuple[Path, ...] = ()

    def paint(self, scene: ViewScene, under: Colours) -> tuple[Colours, NDArray[np.bool_]]:
        """See `ViewLayer`."""
        there, light = scene.seen.owner >= 0, illumination(scene.seen.normal, self.light)
        if self.first:
            return np.broadcast_to(255 * light, under.shape).astype(np.float32), there
        return shaded(under, light, self.light.level, self.strength), there


@dataclass(frozen=True)
class Tint:
    """Colours by height, or by slope."""

    ramp: Ramp
    slope: bool = False
    files: tuple[Path, ...] = ()

    def paint(self, scene: ViewScene, under: Colours) -> tuple[Colours, NDArray[np.bool_]]:
        """See `ViewLayer`."""
        seen = scene.seen
        values = np.degrees(np.arccos(np.clip(seen.normal[..., 2], 0, 1))) if self.slope else seen.XYZ[..., 2]
        return self.ramp(values.astype(np.float32)), seen.owner >= 0


@dataclass(frozen=True, eq=False)
class Resampled:
    """Images that are resampled by the engine: a raster on the map, or photos, of which each pixel takes the best."""

    sources: tuple[Source, ...]
    files: tuple[Path, ...]
    span: tuple[float, float]
    """Values that become black and white."""
    photos: bool
    classes: bool = False
    """True if its values are numbers of classes, which are never mixed."""

    def paint(self, scene: ViewScene, under: Colours) -> tuple[Colours, NDArray[np.bool_]]:
        """See `ViewLayer`."""
        kernel = "nearest" if self.classes else scene.kernel
        rule = AnchorRule.of(kernel, scene.tolerance, tilted=True)
        rows, window = tuple(range(len(self.sources))), scene.tile.window
        owners = None
        if self.photos:
            photos = [cast("CentralCamera", source.camera) for source in self.sources]
            owner = best_photos(photos, scene.seen, scene.surface)
            owners = _Given(window, owner)
        tiles = Tiles(window, max(window.width, window.height), np.zeros(1, np.uint32), rows)
        plan = ProductPlan(
            name="view", sources=tuple(map(str, rows)), target=scene.target, rule=rule, tiles=tiles, owners=owners
        )
        painted = render(plan, Tile(0, window, rows), self.sources, scene, kernel)
        if painted.values is None or painted.valid is None:
            return under, np.zeros(under.shape[1:], bool)
        if self.classes and len(painted.values) == 1:
            return class_colours(painted.values[0]), painted.valid
        return in_colours(painted.values, self.span), painted.valid


@dataclass(frozen=True, eq=False)
class _Given:
    """Owners of the pixels of a window."""

    window: Window
    owner: NDArray[np.uint16]

    def share(self, ground: TileGround, cameras: Mapping[int, Projection], surface: Surface) -> Share:
        """See `Ownership`."""
        return Share(self.owner[ground.window.slices(self.window)])


def illumination(normal: NDArray[np.float64], light: Lighting) -> NDArray[np.float32]:
    """Light on a matt surface with these normals, 0 to 1; NaN where there is none."""
    n = normal * (light.exaggeration, light.exaggeration, 1.0)
    sun = directions(light)[0]
    return np.asarray(np.clip(n @ sun / np.linalg.norm(n, axis=-1), 0, None), np.float32)


def open_layers(
    requests: Sequence[ContentRequest], ground: ViewGround, light: Lighting, heights: tuple[float, float]
) -> tuple[ViewLayer, ...]:
    """Contents, ready to paint."""
    return tuple(_layer(request, k == 0, ground, light, heights) for k, request in enumerate(requests))


def _layer(
    request: ContentRequest, first: bool, ground: ViewGround, light: Lighting, heights: tuple[float, float]
) -> ViewLayer:
    if request.kind == "shade":
        return Shade(light, request.opacity, first)
    if request.kind == "slope":
        return Tint(SLOPES, slope=True)
    if request.kind == "tint":
        return Tint(_ramp(request.value, heights))
    if request.kind == "raster":
        return _raster(request, ground)
    project = ground.named
    names = project.select([request.value] if request.kind == "photo" else None)
    names = [name for name in names if project.image(name).center is not None]
    scenes = [open_scene(project, name) for name in names]
    if not scenes or any(taken_apart(s.camera) is None for s in scenes):
        raise InputError("photos as content need oriented images of frame cameras; the project has others")
    kinds = {(s.reader.bands, s.reader.dtype) for s in scenes}
    if len(kinds) > 1:
        raise InputError("photos of one content have the same bands and type of pixels; choose one with photo:NAME")
    sources = tuple(Source(s.camera, s.reader) for s in scenes)
    return Resampled(sources, tuple(s.reader.path for s in scenes), grey_span(scenes[0].reader), photos=True)


def _ramp(text: str, heights: tuple[float, float]) -> Ramp:
    name, *span = text.split(":") if text else ["hypsometric"]
    if name not in RAMPS or len(span) not in (0, 2):
        raise UsageError(f"tint {text!r}; give tint, tint:RAMP or tint:RAMP:LOW:HIGH with RAMP of {', '.join(RAMPS)}")
    try:
        low, high = (float(v) for v in span) if span else heights
    except ValueError:
        raise UsageError(f"tint {text!r}: heights of the ramp are two numbers, metres") from None
    return built_in_ramp(name, low, high)


def _raster(request: ContentRequest, ground: ViewGround) -> ViewLayer:
    path = Path(request.value)
    reader = RasterReader(path)
    stating = stated_classes(reader.info)
    if request.classes and stating is None:
        if reader.bands != 1 or reader.dtype.kind not in "iu":
            raise UsageError(
                f"content {path}@classes: {reader.bands} bands of {reader.dtype}; classes are whole numbers in one band"
            )
        stating = ()
    placement = placement_of(reader.info)
    if placement.transform is None:
        raise InputError(f"{path}: lies nowhere (no georeference); a content is a raster on the map, or photo:NAME")
    if placement.crs is None:
        raise InputError(f"{path}: no CRS; it is not guessed. That of the terrain is {crs_label(ground.crs)}")
    carry = (
        None
        if same_crs(placement.crs, ground.crs)
        else crs_step(ground.crs, placement.crs, ground.bounds, placement.middle[0])
    )
    source = Source(MapProjection(placement, carry), reader)
    # Between numbers of classes nothing has a meaning.
    span = (0.0, 255.0) if stating is not None else grey_span(reader)
    files = (reader.path, *(stating or ()))
    return Resampled((source,), files, span, photos=False, classes=stating is not None)


def in_colours(values: NDArray[Any], span: tuple[float, float]) -> Colours:
    """Pixels of an image (bands, height, width) as colours; `span` becomes black and white."""
    colours = values[[0, 1, 2] if len(values) >= 3 else [0, 0, 0]].astype(np.float32)
    if span != (0.0, 255.0):
        colours = np.clip((colours - span[0]) * (255 / (span[1] - span[0])), 0, 255)
    return colours.astype(np.float32)


def class_colours(numbers: NDArray[Any]) -> Colours:
    """Return colours (3, height, width) of numbers of classes: hues far apart for numbers that follow each other."""
    found, place = np.unique(numbers, return_inverse=True)
    n = found.astype(np.float64)
    hue, light = 2 * np.pi * np.mod(n * _GOLDEN, 1.0), np.array([0.62, 0.45, 0.78])[np.mod(n, 3).astype(int)]
    turned = hue[:, None] + np.array([0.0, -2.0, 2.0]) * np.pi / 3
    table = np.rint(255 * (light[:, None] + 0.22 * np.cos(turned) * np.sqrt(2))).clip(0, 255)
    return np.moveaxis(table[place.reshape(numbers.shape)], -1, 0).astype(np.float32)


def grey_span(reader: Reader) -> tuple[float, float]:
    """Values that become black and white: all of a byte, else from the second to the ninety-eighth percentile."""
    if reader.dtype == np.uint8:
        return 0.0, 255.0
    level = max(0, math.ceil(math.log2(max(reader.size) / _LOOKED)))
    values, valid = reader.read(Window(0, 0, *level_size(reader.size, level)), level)
    known = values[:, valid] if valid is not None else values.reshape(len(values), -1)
    known = known[np.isfinite(known)]
    low, high = np.percentile(known, _PERCENT) if known.size else (0.0, 1.0)
    return float(low), float(max(high, low + 1e-9))


#: Lines are simplified by at most this, pixels.
_SIMPLER = 0.03
#: Free space around labels, and between the lowest place of a label and its point, pixels.
_MARGIN, _LOWEST = 2, 8
_INK, _HALO = (20, 26, 30), (255, 255, 255)
_LEADER = LineStyle(_INK, 1.0)


@dataclass(frozen=True, eq=False)
class Letters:
    """A text as it is drawn."""

    cover: NDArray[np.float32]
    """Part of each pixel that is covered, shape (rows, columns)."""
    baseline: float
    """Rows from the upper edge."""


Lettering = Callable[[str], Letters]


@dataclass(frozen=True, eq=False)
class Label:
    """A text at its place."""

    text: str
    letters: Letters
    column: int
    row: int
    """Place of the upper left pixel of the text."""


@dataclass(frozen=True, eq=False)
class Stroke:
    """Lines of one style, in pixels."""

    style: LineStyle
    pieces: tuple[NDArray[np.float64], ...]
    """Vertices (n, 2) of each; one vertex is a mark."""

    @property
    def segments(self) -> NDArray[np.float64]:
        """Both ends of what is drawn, shape (n, 4); dashes are cut."""
        pieces = [cut for piece in self.pieces for cut in dashed(piece, self.style.dash)]
        ends = [np.concatenate([p[:-1], p[1:]], axis=1) if len(p) > 1 else np.tile(p, (1, 2)) for p in pieces]
        return np.concatenate([np.empty((0, 4)), *ends])


@dataclass(frozen=True)
class OverlayFacts:
    """Counts of what was drawn."""

    features: int
    """Lines and points."""
    seen: int
    """Features of which something is seen."""
    labels: int
    """Labels that are drawn."""
    unplaced: int
    """Labels of points that are seen for which there was no room."""


@dataclass(frozen=True, eq=False)
class Overlay:
    """All of it, in the order of drawing."""

    size: tuple[int, int]
    strokes: tuple[tuple[LineStyle, NDArray[np.float64]], ...]
    """Style and segments (n, 4)."""
    layers: tuple[Stroke, ...]
    """The same before dashes are cut, for SVG."""
    labels: tuple[Label, ...]
    text_size: float
    """Pixels."""
    facts: OverlayFacts

    def paint(self, picture: NDArray[np.uint8], window: Window, shift: int = 0) -> None:
        """Draw what lies in a window of the picture into its pixels, shape (3, height, width); or that many columns
        beside it. Nothing is drawn beyond the picture."""
        inside = Window(shift, 0, *self.size) & window
        if not inside.size:
            return
        picture = picture[:, *inside.slices(window)]
        window = Window(inside.col - shift, inside.row, inside.width, inside.height)
        corner = np.array([window.col, window.row] * 2, float)
        for style, segments in self.strokes:
            reach = style.width / 2 + 1
            low, high = np.minimum(segments[:, :2], segments[:, 2:]), np.maximum(segments[:, :2], segments[:, 2:])
            stop = np.array(window.stop, float)
            near = ((high >= corner[:2] - reach) & (low <= stop - 1 + reach)).all(axis=1)
            if near.any():
                cover = np.zeros((window.height, window.width), np.float32)
                draw_lines(segments[near] - corner, style.width, cover)
                _blend(picture, cover, style.colour)
        for label in self.labels:
            cover = np.pad(label.letters.cover, _MARGIN)
            area = Window(label.column - _MARGIN, label.row - _MARGIN, cover.shape[1], cover.shape[0])
            both = area & window
            if both.size:
                at, own = (np.s_[:, *both.slices(window)], both.slices(area))
                for part, colour in ((maximum_filter(cover, 3)[own] * np.float32(0.85), _HALO), (cover[own], _INK)):
                    _blend(picture[at], part, colour)

    def svg(self, picture: str | None) -> str:
        """Return an SVG of the picture's size; `picture` is the file that lies below it, next to the SVG."""
        width, height = self.size
        out = [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="-0.5 -0.5 {width} {height}">',
        ]
        if picture is not None:
            out.append(
                f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href={xml_quoted(picture)} '
                'preserveAspectRatio="none"/>'
            )
        for stroke in self.layers:
            style = stroke.style
            colour = "#{:02x}{:02x}{:02x}".format(*style.colour)
            dash = f' stroke-dasharray="{" ".join(f"{d:g}" for d in style.dash)}"' if style.dash else ""
            out.append(
                f'<g fill="none" stroke="{colour}" stroke-width="{style.width:g}" stroke-linecap="round" '
                f'stroke-linejoin="round"{dash}>'
            )
            for piece in stroke.pieces:
                out.append('<path d="M' + "L".join(f"{x:.2f} {y:.2f}" for x, y in _two(piece)) + '"/>')
            out.append("</g>")
        out.append(
            f'<g font-family="DejaVu Sans, sans-serif" font-size="{self.text_size:g}" fill="rgb{_INK}" '
            f'stroke="rgb{_HALO}" stroke-width="2.5" stroke-linejoin="round" paint-order="stroke">'
        )
        for label in self.labels:
            y = label.row - 0.5 + label.letters.baseline
            out.append(f'<text x="{label.column - 0.5:g}" y="{y:.2f}">{xml_text(label.text)}</text>')
        return "\n".join([*out, "</g>", "</svg>", ""])


def _two(piece: NDArray[np.float64]) -> list[list[float]]:
    """Vertices of a path; of a mark twice the same, which round ends make a dot."""
    return [*piece.tolist(), *(piece.tolist() if len(piece) == 1 else [])]


def _blend(picture: NDArray[np.uint8], cover: NDArray[np.float32], colour: tuple[int, int, int]) -> None:
    """Lay a colour over pixels (3, height, width), as much of it as is covered."""
    over = np.array(colour, np.float32)[:, None, None]
    picture[:] = np.rint(picture + cover * (over - picture))


def dashed(piece: NDArray[np.float64], dash: tuple[float, ...]) -> list[NDArray[np.float64]]:
    """A line (n, 2) cut into strokes with gaps between them; their lengths are in pixels."""
    if not dash or len(piece) < 2:
        return [piece]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(piece, axis=0).T))])
    ends = np.cumsum(np.tile(dash, int(along[-1] / sum(dash)) + 1))
    starts = np.concatenate([[0.0], ends[1:-1:2]])
    out = []
    for a, b in zip(starts.tolist(), np.minimum(ends[::2], along[-1]).tolist()):
        if b > a:
            at = np.concatenate([[a], along[(along > a) & (along < b)], [b]])
            out.append(np.column_stack([np.interp(at, along, piece[:, k]) for k in (0, 1)]))
    return out


def overlay(drawing: Drawing, sight: LinesOfSight, lettering: Lettering | None, text_size: float) -> Overlay:
    """Find what is seen of a drawing, and places for labels."""
    seen = sight.lines(drawing.lines)
    layers = [
        Stroke(style, tuple(simpler(seen, np.flatnonzero(drawing.style[seen.line] == k))))
        for k, style in enumerate(drawing.styles)
    ]
    points = LinesOfSight(sight.target, sight.surface, LIFT_OF_POINTS).points(drawing.points)
    at = np.flatnonzero(points.shown)
    marks = [Stroke(s, tuple(points.uv[[i]] for i in at[drawing.point_style[at] == k])) for k, s in
             enumerate(drawing.styles)]  # fmt: skip
    order = at[np.argsort(np.where(np.isnan(drawing.rank[at]), -points.XYZ[at, 2], drawing.rank[at]), kind="stable")]
    asked = [
        (_text(drawing.labels[i], float(points.XYZ[i, 2]), float(points.distance[i])), points.uv[i])
        for i in order.tolist()
        if drawing.labels[i] and lettering is not None
    ]
    labels, leaders = placed(asked, points.uv[at], lettering, sight.target.bundle.size) if lettering else ([], [])
    layers = [each for each in (*layers, *marks, Stroke(_LEADER, tuple(leaders))) if each.pieces]
    features = len(drawing.style) + len(drawing.points)
    facts = OverlayFacts(features, len(np.unique(seen.line)) + len(at), len(labels), len(asked) - len(labels))
    strokes = tuple((each.style, each.segments) for each in layers)
    return Overlay(
        size=sight.target.bundle.size,
        strokes=strokes,
        layers=tuple(layers),
        labels=tuple(labels),
        text_size=text_size,
        facts=facts,
    )


def simpler(seen: SeenLines, pieces: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Vertices of some pieces, without those that the picture does not need."""
    use = np.isin(seen.piece, pieces)
    if not use.any():
        return []
    number = np.unique(seen.piece[use], return_inverse=True)[1].reshape(-1)
    lines = shapely.simplify(shapely.linestrings(seen.uv[use], indices=number), _SIMPLER)
    return [shapely.get_coordinates(line) for line in lines]


def _text(label: str, H: float, distance: float) -> str:
    away = f"{distance / 1000:.1f} km" if distance >= 1000 else f"{distance:.0f} m"
    return label.replace("{H}", f"{H:.0f} m").replace("{distance}", away)


Box = tuple[float, float, float, float]
"""Left, top, right, bottom, pixels."""


def placed(
    asked: Sequence[tuple[str, NDArray[np.float64]]],
    marks: NDArray[np.float64],
    lettering: Lettering,
    size: tuple[int, int],
) -> tuple[list[Label], list[NDArray[np.float64]]]:
    """Places of labels above their points, each with a leader to its point; the first ones choose first.

    A label stands as low as it can where it covers no other label, leader or mark, and its leader crosses no label.
    """
    labels: list[Label] = []
    leaders: list[NDArray[np.float64]] = []
    boxes: list[Box] = []
    lines: list[Box] = [(x - 3, y - 3, x + 3, y + 3) for x, y in marks.tolist()]
    for text, (x, y) in asked:
        letters = lettering(text)
        height, width = letters.cover.shape
        found = next(
            (
                (left, top)
                for top in range(int(y) - _LOWEST - height, _MARGIN - 1, -4)
                for left in (int(x - width / 2), int(x) - 4, int(x) + 4 - width)
                if left >= _MARGIN
                and left + width <= size[0] - _MARGIN
                and _fits(
                    (left, top, left + width, top + height), (x - 0.5, top + height, x + 0.5, y - 4), boxes, lines
                )
            ),
            None,
        )
        if found is None:
            continue
        left, top = found
        labels.append(Label(text, letters, left, top))
        boxes.append((left, top, left + width, top + height))
        lines.append((x - 0.5, top + height, x + 0.5, y))
        leaders.append(np.array([(x, top + height + 1.0), (x, y - 3.0)]))
    return labels, leaders


def _fits(box: Box, leader: Box, boxes: Sequence[Box], lines: Sequence[Box]) -> bool:
    """Return True if a label and its leader keep away from what is there."""
    if any(_meet(box, other, 2 * _MARGIN) or _meet(leader, other, _MARGIN) for other in boxes):
        return False
    return not any(_meet(box, other, _MARGIN) for other in lines)


def _meet(a: Box, b: Box, margin: float) -> bool:
    return a[0] < b[2] + margin and b[0] < a[2] + margin and a[1] < b[3] + margin and b[1] < a[3] + margin
