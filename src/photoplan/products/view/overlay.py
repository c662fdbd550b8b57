"""What is drawn over the picture of a view: strokes of constant width, marks, and labels; as pixels and as SVG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from photoplan.geometry.grid import Window
from photoplan.kernels.strokes import draw_strokes
from photoplan.plain import xml_quoted, xml_text
from photoplan.products.view.lines import Drawing, LineStyle
from photoplan.surfaces.seen_lines import LIFT_OF_POINTS, LinesOfSight, SeenLines

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
    """Of the upper left pixel of the text."""


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
    """What became of what was to be drawn."""

    features: int
    """Lines and points."""
    seen: int
    """Those of which something is seen."""
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
                draw_strokes(segments[near] - corner, style.width, cover)
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
        """As an SVG of the picture's size; `picture` is the name of the file that lies below it, beside the SVG."""
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
    """Whether a label and its leader keep away from what is there."""
    if any(_meet(box, other, 2 * _MARGIN) or _meet(leader, other, _MARGIN) for other in boxes):
        return False
    return not any(_meet(box, other, _MARGIN) for other in lines)


def _meet(a: Box, b: Box, margin: float) -> bool:
    return a[0] < b[2] + margin and b[0] < a[2] + margin and a[1] < b[3] + margin and b[1] < a[3] + margin
