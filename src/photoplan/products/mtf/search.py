"""Edges sought in an image of any size: tile by tile, lines across tiles joined."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import ceil, cos, floor, hypot, radians

from photoplan.geometry.grid import Window
from photoplan.products.mtf.image import LightImage
from photoplan.quality.edges.candidates import StraightEdge, find_lines
from photoplan.quality.edges.find import EdgeRegion, EdgeRules, examine

#: Side of a tile, pixels: its arrays take some 200 MB.
TILE = 2048
#: Longest line that is examined as one, pixels: bounds the window that is read for it, and how far lenses bend it.
LONGEST = 512.0
#: Longest part that is measured as one: no lens, print or roof is straight to a tenth of a pixel for longer.
PART = 256.0
#: Cells of the field, in each direction, among which edges are chosen in turn.
_CELLS = 6
#: Edges of a cell that are kept while the search goes on.
_KEPT = 300
_ACROSS = 1.5
_ALONG = 6.0
_TURNED = cos(radians(2.0))


@dataclass
class FoundEdges:
    """Edges that can be measured, and how many others were rejected for what."""

    regions: list[EdgeRegion] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)


def tiles_of(area: Window) -> list[Window]:
    """Tiles that cover an area."""
    columns, rows = (max(1, -(-side // TILE)) for side in (area.width, area.height))
    across = [area.col + area.width * k // columns for k in range(columns + 1)]
    down = [area.row + area.height * k // rows for k in range(rows + 1)]
    return [
        Window(across[j], down[i], across[j + 1] - across[j], down[i + 1] - down[i])
        for i in range(rows)
        for j in range(columns)
    ]


def search_edges(
    image: LightImage,
    channel: int,
    area: Window,
    rules: EdgeRules,
    advance: Callable[[int, int], None] = lambda tiles, pixels: None,
) -> FoundEdges:
    """Edges in a part of an image; pixels outside that part are not used."""
    found, open_lines = FoundEdges(), []
    margin = max(rules.halves) + 4
    for tile in tiles_of(area):
        col, row = max(area.col, tile.col - margin), max(area.row, tile.row - margin)
        right, bottom = (min(a, t + margin) for a, t in zip(area.stop, tile.stop))
        read = Window(col, row, right - col, bottom - row)
        picture = image.picture(read, channel)
        lines, reasons = find_lines(picture.grey, picture.valid, rules.least_length)
        found.rejected += reasons
        for line in lines:
            inside = _clipped(line, (tile.col - col, tile.row - row, tile.stop[0] - col, tile.stop[1] - row))
            if inside is None:
                continue
            # A line that leaves the tile goes on in the next one.
            if inside.length < line.length - 0.5:
                open_lines.append(inside.moved(col, row))
                continue
            for part in _pieces(line):
                region, reason = examine(picture, part, rules)
                if region is None:
                    found.rejected[reason] += 1
                else:
                    found.regions.append(_placed(region, col, row))
        found.regions = _best_of_cells(found.regions, image.size)
        advance(1, tile.size)
    for line in join_lines(open_lines):
        for part in _pieces(line):
            _examine_alone(image, channel, area, part, rules, found)
    numbered = [replace(region, of=k) for k, region in enumerate(sorted(found.regions, key=lambda r: -r.merit), 1)]
    parts = [part for region in numbered for part in parted(region, ceil(region.line.length / PART))]
    found.regions = sorted(parts, key=lambda region: -region.merit)
    return found


def _examine_alone(
    image: LightImage, channel: int, area: Window, line: StraightEdge, rules: EdgeRules, found: FoundEdges
) -> None:
    """Examine a line in a window of its own."""
    if line.length < rules.least_length:
        return
    reach = max(rules.halves) + 4
    xs, ys = zip(*line.ends)
    around = Window(
        max(0, floor(min(xs)) - reach),
        max(0, floor(min(ys)) - reach),
        floor(max(xs) - min(xs)) + 2 * reach + 2,
        floor(max(ys) - min(ys)) + 2 * reach + 2,
    )
    window = area & around
    if window.size == 0:
        return
    region, reason = examine(image.picture(window, channel), line.moved(-window.col, -window.row), rules)
    if region is None:
        found.rejected[reason] += 1
    else:
        found.regions.append(_placed(region, window.col, window.row))


def parted(region: EdgeRegion, count: int) -> list[EdgeRegion]:
    """An edge in parts of equal length, each an edge of its own."""
    if count < 2:
        return [region]
    step = region.line.length / count
    parts = []
    for k in range(count):
        shift = (k + 0.5) * step - region.line.length / 2
        gaps = tuple((a - shift, b - shift) for a, b in region.gaps if b - shift > -step / 2 and a - shift < step / 2)
        parts.append(replace(region, line=region.line.part(k * step, (k + 1) * step), gaps=gaps))
    return parts


def _placed(region: EdgeRegion, dx: float, dy: float) -> EdgeRegion:
    return replace(region, line=region.line.moved(dx, dy))


def _clipped(line: StraightEdge, box: tuple[int, int, int, int]) -> StraightEdge | None:
    """The part of a line inside a box of pixels (left, top, right, bottom); None: it is outside."""
    start, end = 0.0, line.length
    (x0, y0), _ = line.ends
    for at, step, low, high in ((x0, line.tx, box[0], box[2]), (y0, line.ty, box[1], box[3])):
        if abs(step) < 1e-12:
            if not low - 0.5 <= at < high - 0.5:
                return None
            continue
        a, b = sorted(((low - 0.5 - at) / step, (high - 0.5 - at) / step))
        start, end = max(start, a), min(end, b)
    return line.part(start, end) if end > start else None


def join_lines(lines: Iterable[StraightEdge]) -> list[StraightEdge]:
    """Lines of which one goes on where another ends become one, the longest first."""
    waiting = sorted(lines, key=lambda line: -line.length)
    joined: list[StraightEdge] = []
    while waiting:
        line = waiting.pop(0)
        while True:
            at = next((k for k, other in enumerate(waiting) if _goes_on(line, other)), None)
            if at is None:
                break
            other = waiting.pop(at)
            ends = sorted([*line.ends, *other.ends], key=lambda p: p[0] * line.tx + p[1] * line.ty)
            line = StraightEdge.between(ends[0], ends[-1], max(line.strength, other.strength))
        joined.append(line)
    return joined


def _goes_on(line: StraightEdge, other: StraightEdge) -> bool:
    """Whether another line begins where this one ends, or the reverse, in the same direction."""
    reach = (line.length + other.length) / 2 + _ALONG
    if hypot(line.x - other.x, line.y - other.y) > reach:
        return False
    # A short piece knows its direction less well.
    if line.tx * other.tx + line.ty * other.ty < (_TURNED if min(line.length, other.length) > 12 else 0.97):
        return False
    ends = [(a, b) for a, b in ((line.ends[1], other.ends[0]), (other.ends[1], line.ends[0]))]
    return any(
        hypot(a[0] - b[0], a[1] - b[1]) <= _ALONG and abs((b[1] - a[1]) * line.tx - (b[0] - a[0]) * line.ty) <= _ACROSS
        for a, b in ends
    )


def _pieces(line: StraightEdge) -> list[StraightEdge]:
    """A line in parts that are not too long."""
    count = max(1, -(-int(line.length) // int(LONGEST)))
    step = line.length / count
    return [line.part(k * step, (k + 1) * step) for k in range(count)]


def _cell(region: EdgeRegion, size: tuple[int, int]) -> tuple[int, int]:
    return (
        min(max(int(_CELLS * region.line.x / size[0]), 0), _CELLS - 1),
        min(max(int(_CELLS * region.line.y / size[1]), 0), _CELLS - 1),
    )


def _best_of_cells(regions: Sequence[EdgeRegion], size: tuple[int, int]) -> list[EdgeRegion]:
    """The best of each cell of the field: bounds what is kept."""
    if len(regions) <= _KEPT:
        return list(regions)
    taken: Counter[tuple[int, int]] = Counter()
    kept = []
    for region in sorted(regions, key=lambda r: -r.merit):
        cell = _cell(region, size)
        taken[cell] += 1
        if taken[cell] <= _KEPT:
            kept.append(region)
    return kept


def select_spread(regions: Sequence[EdgeRegion], size: tuple[int, int], most: int) -> list[EdgeRegion]:
    """The best edges, spread over the field and over both directions: each cell gives its next best in turn."""
    queues: dict[tuple[int, int, bool], list[EdgeRegion]] = {}
    for region in sorted(regions, key=lambda r: -r.merit):
        queues.setdefault((*_cell(region, size), abs(region.line.tx) > abs(region.line.ty)), []).append(region)
    chosen: list[EdgeRegion] = []
    turn = 0
    while len(chosen) < most and any(len(queue) > turn for queue in queues.values()):
        row = sorted((q[turn] for q in queues.values() if len(q) > turn), key=lambda r: -r.merit)
        chosen += row[: most - len(chosen)]
        turn += 1
    return chosen
