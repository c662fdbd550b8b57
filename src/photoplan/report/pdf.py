"""Reports as PDF: a document of `report.page` on A4 pages, in which text stays text and plots stay lines."""

from __future__ import annotations

import base64
import importlib
import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from html.parser import HTMLParser
from typing import Any

import numpy as np

from photoplan.report.page import INK, SOFT, figure_of, mpl, png, shortened, styled

#: Sides of the page, margins at the sides, at the top and at the bottom, points.
_PAGE, _SIDE, _TOP, _BOTTOM = (595.28, 841.89), 43.0, 46.0, 54.0
_WIDE = _PAGE[0] - 2 * _SIDE
_ACCENT, _RULE, _GROUND = "#0b5c8c", "#d7dee3", "#f6f8f9"
#: Height of a line over the size of its letters.
_LEADING = 1.32
_BOXES, _GAP, _PAD = 3, 8.0, 7.0
#: A plot becomes smaller by this factor at most if it then stands on the page that was begun.
_SMALLER = 0.65
#: Lines of one cell of a table that stand together; more go on below.
_MOST_LINES = 40
#: Points of plots beyond which a plot is a picture.
_MOST_POINTS = 60_000

Row = list[tuple[str, bool]]


class _Reader(HTMLParser):
    """Blocks of a document in their order: words by the name of their element, boxes, tables, pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks: list[tuple[str, Any]] = []
        self.text = ""
        self.number = False

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        """Open a block or a part of one."""
        told = dict(attrs)
        if tag in ("h1", "h2", "h3", "p", "dt", "dd", "figcaption", "th", "td", "title"):
            self.text, self.number = "", told.get("class") == "number"
        if tag in ("dl", "table"):
            self.blocks.append((tag, []))
        elif tag == "tr" or (tag == "div" and self.blocks and self.blocks[-1][0] == "dl"):
            self.blocks[-1][1].append([])
        elif tag == "img":
            self.blocks.append(("figure", [base64.b64decode((told.get("src") or "").partition(",")[2]), ""]))

    def handle_data(self, data: str) -> None:
        """Collect words."""
        self.text += data

    def handle_endtag(self, tag: str) -> None:
        """Keep the words of what ends."""
        words = " ".join("".join(map(_drawn, self.text)).split())
        if tag in ("h1", "h2", "h3", "p"):
            self.blocks.append((tag, words))
        elif tag in ("dt", "dd"):
            self.blocks[-1][1][-1].append(words)
        elif tag in ("th", "td"):
            self.blocks[-1][1][-1].append((words, self.number))
        elif tag == "figcaption":
            self.blocks[-1][1][1] = words


@cache
def _font(bold: bool) -> Any:
    manager = importlib.import_module("matplotlib.font_manager")
    path = manager.findfont(manager.FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal"))
    font = importlib.import_module("matplotlib.ft2font").FT2Font(path)
    font.set_size(100, 72)
    return font


@cache
def _advance(letter: str, bold: bool) -> float:
    """Return the width of a letter over its size."""
    return float(_font(bold).load_char(ord(letter)).linearHoriAdvance) / 65536 / 100


@cache
def _drawn(letter: str) -> str:
    """Return a letter, or what stands for one that the font lacks."""
    known = letter.isspace() or all(_font(bold).get_char_index(ord(letter)) for bold in (False, True))
    return letter if known else "\ufffd"


def _width(words: str, size: float, bold: bool = False) -> float:
    return size * sum(_advance(letter, bold) for letter in words)


def _wrapped(words: str, size: float, width: float, bold: bool = False) -> list[str]:
    """Return the lines of words in a width; a word that is wider is broken."""
    lines, line, used = [], "", 0.0
    for word in words.split():
        wide = _width(word, size, bold)
        space = _width(" ", size, bold) if line else 0.0
        if line and used + space + wide > width:
            lines.append(line)
            line, used, space = "", 0.0, 0.0
        if wide <= width:
            line, used = f"{line} {word}" if line else word, used + space + wide
            continue
        for letter in word:
            step = _width(letter, size, bold)
            if line and used + step > width:
                lines.append(line)
                line, used = "", 0.0
            line, used = line + letter, used + step
    return [*lines, line] if line else lines


class _Paper:
    """Pages under way: what is drawn on each, and the height that is left on the last one; y counts from below."""

    def __init__(self, plots: Mapping[bytes, Any]) -> None:
        self.plots = plots
        self.pages: list[list[Callable[[Any], None]]] = [[]]
        self.y = _PAGE[1] - _TOP
        self.heads: list[tuple[str, float, bool]] = []
        """Headings that stand with what follows: words, size, ruled."""

    def left(self) -> float:
        """Return the height that is left below headings that wait."""
        return self.y - _BOTTOM - sum(_LEADING * size + 20 for _, size, _ in self.heads)

    def room(self, height: float) -> bool:
        """Go to a new page unless so much height is left, and write headings that wait; True if it did."""
        new = height > self.left() and bool(self.pages[-1])
        if new:
            self.pages.append([])
            self.y = _PAGE[1] - _TOP
        heads, self.heads = self.heads, []
        for words, size, ruled in heads:
            self.y -= 14 if ruled else 6
            self.paragraph(words, size, bold=True, after=0)
            if ruled:
                self.rule(self.y)
            self.y -= 6 if ruled else 3
        return new

    def put(self, draw: Callable[[Any], None]) -> None:
        """Draw on the last page when it is made."""
        self.pages[-1].append(draw)

    def words(self, x: float, y: float, words: str, size: float, **how: Any) -> None:
        """Write one line."""
        self.put(lambda fig: _write(fig, x, y, words, size, **how))

    def rule(self, y: float, colour: str = _RULE, width: float = 0.6) -> None:
        """Draw a line across the page."""
        at = [_SIDE / _PAGE[0], 1 - _SIDE / _PAGE[0]], [y / _PAGE[1]] * 2
        self.put(lambda fig: fig.add_artist(mpl.lines.Line2D(*at, color=colour, linewidth=width)))

    def paragraph(self, words: str, size: float, bold: bool = False, colour: str = INK, after: float = 5.0) -> None:
        """Write words over the width of the page."""
        lines = _wrapped(words, size, _WIDE, bold)
        for k, line in enumerate(lines):
            self.room(min(3 if k == 0 else 1, len(lines)) * _LEADING * size)
            self.y -= _LEADING * size
            self.words(_SIDE, self.y + 0.25 * size, line, size, bold=bold, colour=colour)
        self.y -= after

    def block(self, kind: str, content: Any) -> None:
        """Lay out one block."""
        match kind:
            case "h1":
                self.paragraph(content, 17, bold=True, after=2)
            case "h2" | "h3":
                self.heads.append((content, 12.5 if kind == "h2" else 10.0, kind == "h2"))
            case "p":
                self.paragraph(content, 8.8)
            case "dl":
                for at in range(0, len(content), _BOXES):
                    self.boxes(content[at : at + _BOXES])
            case "table":
                self.table(content)
            case "figure":
                self.picture(*content)

    def boxes(self, row: Sequence[Sequence[str]]) -> None:
        """Write large figures side by side; name, value and remark of each."""
        wide = (_WIDE - (_BOXES - 1) * _GAP) / _BOXES
        styles = ((1, 13.0, True, INK), (0, 8.2, True, INK), (2, 7.4, False, SOFT))
        filled = [
            [
                (line, size, bold, colour)
                for k, size, bold, colour in styles
                if k < len(box)
                for line in _wrapped(box[k], size, wide - 2 * _PAD, bold)[:_MOST_LINES]
            ]
            for box in row
        ]
        tall = max(sum(_LEADING * size for _, size, *_ in lines) for lines in filled) + 2 * _PAD
        self.room(tall)
        for k, lines in enumerate(filled):
            x, y = _SIDE + k * (wide + _GAP), self.y - _PAD
            self.put(lambda fig, x=x, low=self.y - tall: _fill(fig, x, low, wide, tall))  # type: ignore[misc]
            for line, size, bold, colour in lines:
                y -= _LEADING * size
                self.words(x + _PAD, y + 0.25 * size, line, size, bold=bold, colour=colour)
        self.y -= tall + _GAP

    def table(self, rows: Sequence[Row]) -> None:
        """Write a table; its head stands on every page that it reaches."""
        count = max(map(len, rows), default=0)
        if not count:
            return
        filled = [row + [("", False)] * (count - len(row)) for row in rows]
        gap, size = 9.0, 8.0
        numbers = [any(row[k][1] for row in filled) for k in range(count)]
        natural = [0.0] * count
        for size in (8.0, 7.0, 6.2, 5.4):
            natural = [max(_width(row[k][0], size, row is filled[0]) for row in filled) + gap for k in range(count)]
            # Words may go on in the next line, numbers should not.
            if sum(wide if number else min(wide, 0.5 * _WIDE) for wide, number in zip(natural, numbers)) <= _WIDE:
                break
        widths = _fitted(natural, _WIDE)
        head, *body = [
            [_wrapped(cell, size, width - gap, row is filled[0]) for (cell, _), width in zip(row, widths)]
            for row in filled
        ]

        def line_of(cells: Sequence[Sequence[str]], aligned: Row, bold: bool) -> None:
            self.y -= 2.5
            for k, lines in enumerate(cells):
                right = aligned[k][1]
                x = _SIDE + sum(widths[: k + 1]) - gap if right else _SIDE + sum(widths[:k])
                for n, words in enumerate(lines, 1):
                    y = self.y - n * _LEADING * size + 0.25 * size
                    self.words(x, y, words, size, bold=bold, colour=SOFT if bold else INK, right=right)
            self.y -= max(1, *map(len, cells)) * _LEADING * size + 2.5
            self.rule(self.y, width=1.2 if bold else 0.5)

        def tall(cells: Sequence[Sequence[str]]) -> float:
            return max(1, *map(len, cells)) * _LEADING * size + 5.0

        head = [lines[:_MOST_LINES] for lines in head]
        self.room(tall(head) + (tall([lines[:_MOST_LINES] for lines in body[0]]) if body else 0.0))
        line_of(head, filled[0], True)
        for cells, aligned in zip(body, filled[1:]):
            for at in range(0, max(1, *map(len, cells)), _MOST_LINES):
                part = [lines[at : at + _MOST_LINES] for lines in cells]
                if self.room(tall(part)):
                    line_of(head, filled[0], True)
                line_of(part, aligned, False)
        self.y -= 10

    def picture(self, data: bytes, caption: str) -> None:
        """Place a plot or a picture with its caption below."""
        lines = _wrapped(caption, 7.8, _WIDE)
        under = len(lines[:_MOST_LINES]) * _LEADING * 7.8 + 14
        most = _PAGE[1] - _TOP - _BOTTOM - under
        plot = self.plots.get(data)
        if plot is not None and _points(plot) > _MOST_POINTS:
            plot, data = None, png(plot)
        if plot is not None:
            wide, tall = (72 * side for side in plot.get_size_inches())
        else:
            pixels = mpl.image.imread(io.BytesIO(data))
            # As a browser shows it, at 96 pixels per inch.
            wide, tall = 0.75 * pixels.shape[1], 0.75 * pixels.shape[0]
        scale = min(1.0, _WIDE / wide, most / tall)
        if _SMALLER * scale * tall <= self.left() - under < scale * tall:
            scale = (self.left() - under) / tall
        wide, tall = scale * wide, scale * tall
        self.room(tall + under)
        x, y = (_PAGE[0] - wide) / 2, self.y - tall
        if plot is not None:
            self.put(lambda fig: _place(fig, plot, scale, (x, y, wide, tall)))
        else:
            self.put(lambda fig: _show(fig, pixels, (x, y, wide, tall)))
        self.y = y - 4
        for line in lines[:_MOST_LINES]:
            self.y -= _LEADING * 7.8
            self.words(_SIDE, self.y + 2, line, 7.8, colour=SOFT)
        self.y -= 10


def _fitted(natural: Sequence[float], width: float) -> list[float]:
    """Return widths of columns whose sum is that of the page: the widest become narrower, or all a little wider."""
    spare = width - sum(natural)
    if spare >= 0:
        return [each + spare / len(natural) for each in natural]
    low, high = 0.0, max(natural)
    for _ in range(40):
        cap = (low + high) / 2
        low, high = (cap, high) if sum(min(each, cap) for each in natural) <= width else (low, cap)
    return [min(each, low) for each in natural]


def _points(plot: Any) -> int:
    """Return the number of points of lines and clouds in a plot."""
    lines = sum(len(each.get_xdata(orig=True)) for each in plot.findobj(mpl.lines.Line2D))
    clouds = plot.findobj(mpl.collections.Collection)
    return int(lines + sum(max(len(c.get_offsets()), sum(len(p.vertices) for p in c.get_paths())) for c in clouds))


def _write(
    fig: Any, x: float, y: float, words: str, size: float, bold: bool = False, colour: str = INK, right: bool = False
) -> None:
    weight, side = "bold" if bold else "normal", "right" if right else "left"
    line = fig.text(x / _PAGE[0], y / _PAGE[1], words, fontsize=size, fontweight=weight, color=colour, ha=side,
                    va="baseline", parse_math=False)  # fmt: skip
    if hasattr(line, "set_fontfeatures"):
        # A search for "figure" does not find a ligature.
        line.set_fontfeatures(("-liga",))


def _fill(fig: Any, x: float, y: float, wide: float, tall: float) -> None:
    """Fill the ground of a box, with a stripe at its left."""
    for width, colour in ((wide, _GROUND), (2.2, _ACCENT)):
        place = (x / _PAGE[0], y / _PAGE[1]), width / _PAGE[0], tall / _PAGE[1]
        fig.add_artist(mpl.patches.Rectangle(*place, facecolor=colour, linewidth=0))


def _show(fig: Any, pixels: Any, place: tuple[float, float, float, float]) -> None:
    x, y, wide, tall = place
    axes = fig.add_axes((x / _PAGE[0], y / _PAGE[1], wide / _PAGE[0], tall / _PAGE[1]))
    axes.imshow(pixels, aspect="auto", interpolation="none", cmap="gray")
    axes.set_axis_off()


def _place(fig: Any, plot: Any, scale: float, place: tuple[float, float, float, float]) -> None:
    """Draw a plot as a part of a page, at the scale of its letters; it is laid out in its new size first."""
    x, y, wide, tall = (each / 72 for each in place)
    plot.dpi = 72
    if scale < 1:
        plot.draw_without_rendering()
        for words in plot.findobj(mpl.text.Text):
            words.set_fontsize(max(5.0, scale * words.get_fontsize()))
        for axes in plot.axes:
            for axis in (axes.xaxis, axes.yaxis):
                labels = axis.get_ticklabels()
                axis.set_tick_params(labelsize=labels[0].get_fontsize() if labels else 7)
        plot.set_size_inches(wide, tall)
    plot.draw_without_rendering()
    plot.set_layout_engine("none")
    plot.bbox_inches.set_points(np.array([[x, y], [x + wide, y + tall]]))
    artist = mpl.artist.Artist()
    artist.draw = plot.draw
    fig.add_artist(artist)


@styled
def printed(document: str, plots: Mapping[bytes, Any]) -> bytes:
    """Return a document of `report.page` as PDF; `plots` holds figures by what stands for their pictures."""
    reader = _Reader()
    reader.feed(document)
    reader.close()
    paper = _Paper(plots)
    title = next((words for kind, words in reader.blocks if kind == "h1"), "")
    for number, (kind, content) in enumerate(reader.blocks):
        if number == 1 and kind == "p":
            # The subtitle belongs to the head.
            paper.paragraph(content, 8.8, colour=SOFT, after=4)
            paper.rule(paper.y, _ACCENT, 2)
            paper.y -= 12
        else:
            paper.block(kind, content)
    paper.room(0)
    out = io.BytesIO()
    told = {"Title": title, "Creator": "photoplan", "Producer": None, "CreationDate": None}
    backend = importlib.import_module("matplotlib.backends.backend_pdf")
    with mpl.rc_context({"pdf.fonttype": 42}), warnings.catch_warnings():
        # A letter that the font lacks becomes a box.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        with backend.PdfPages(out, metadata=told) as file:
            for page in _made(paper.pages, title):
                file.savefig(page)
    return out.getvalue()


def _made(pages: Sequence[Sequence[Callable[[Any], None]]], title: str) -> Iterator[Any]:
    """Yield the pages as figures, each with its number."""
    for number, draws in enumerate(pages, 1):
        fig = figure_of(_PAGE[0] / 72, _PAGE[1] / 72)
        fig.set_layout_engine("none")
        for draw in draws:
            draw(fig)
        _write(fig, _SIDE, 30, shortened(title, 90), 7.4, colour=SOFT)
        _write(fig, _PAGE[0] - _SIDE, 30, f"page {number} of {len(pages)}", 7.4, colour=SOFT, right=True)
        yield fig
