"""The report of a built terrain model: one HTML file that says how good the model is, and why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photoplan.io.product import check_output
from photoplan.report.drawing import draw_normalised, has_matplotlib, load_matplotlib
from photoplan.report.dtm.plots import (
    LINE_WORDS,
    draw_covariance,
    draw_filter_histograms,
    draw_filter_map,
    draw_gross,
    draw_heights,
    draw_sigmas,
)
from photoplan.report.dtm.samples import BuildFacts, PlottedError
from photoplan.report.page import Cell, ReportFile, figure, headline, page, section, table, text
from photoplan.terrain.calibration import ClassFigures

#: Rows of a list at most: more are counted.
MOST_ROWS = 2000
#: Notes of one kind that are spelled out.
MOST_NOTES = 50


def open_build_report(output: Path, wanted: bool | None, overwrite: bool) -> ReportFile | None:
    """The page beside a model to be, before any work; None: it is not wanted, or left open and matplotlib is missing.

    Raises
    ------
    UsageError
        It exists, or it is wanted and matplotlib is missing.
    """
    if wanted is False:
        return None
    path = output.with_name(f"{output.stem}.report.html")
    check_output(path, overwrite=overwrite)
    if wanted is None and not has_matplotlib():
        return None
    load_matplotlib("the report", "give `report=False`")
    return ReportFile(path)


def build_page(facts: BuildFacts) -> str:
    """The report as one HTML document without links to anything outside it.

    Names and texts are escaped; what they contain is shown and never obeyed.
    """
    parts = [
        headline(_headline(facts)),
        section("The surface", _surface(facts)),
        section("How well the model fits its points", _fit(facts)),
        section("What the filter did", _effect(facts)),
        section("Gross errors", _gross(facts)),
        section("What was found in the measurements", _notes(facts)),
        section("Inputs and settings", _record(facts)),
    ]
    return page(facts.title, facts.crs, parts)


def _headline(facts: BuildFacts) -> list[tuple[str, str, str]]:
    """Figure, what it is, and what to compare it with."""
    points = sum(count for kind, count in facts.counts if "point" in kind or "spot" in kind)
    lines = sum(count for _, count in facts.counts) - points
    widths = ", ".join(f"{width:g} m in {_number(count)}" for width, count in facts.widths)
    return [
        (_number(points), "points", "; ".join(f"{kind} {_number(n)}" for kind, n in facts.counts if n)),
        (_number(lines), "lines", "with their intersections with the grid"),
        (_number(facts.units), "computing units", f"{widths}; {_number(facts.empty)} units are empty"),
        (_metres(facts.sigma), "standard deviation of heights", "root mean square over the posts that data surround"),
        (_metres(facts.whole.noise), "noise of mass points", "their filter value"),
        (
            f"{np.sqrt(facts.whole.variance):.3g} m",
            "standard deviation of the signal",
            f"{facts.whole.name} covariance function, half its value at {facts.whole.length:.3g} m",
        ),
        (_plain(facts.spread, 2), "spread of normalised residuals", "1 where the stochastic model fits"),
        (
            _number(len(facts.gross)),
            "gross errors",
            "none were sought" if facts.limit == 0 else f"beyond {facts.limit:g} standard deviations, left out",
        ),
        (_time(facts.seconds), "to build the model", ""),
    ]


def _surface(facts: BuildFacts) -> list[str]:
    kinds = [LINE_WORDS.get(kind, kind) for kind in sorted({kind for kind, _ in facts.map.lines})]
    return [
        figure(
            draw_heights(facts.map),
            "Map of heights",
            f"Heights, shaded as if lit from the north-west. {'Lines: ' + ', '.join(kinds) + '. ' if kinds else ''}"
            "White: no surface, outside the border lines or too far from data.",
        ),
        figure(
            draw_sigmas(facts.map),
            "Map of standard deviations",
            "Standard deviation of the predicted height. It grows where points are sparse and towards the edges.",
        ),
    ]


def _fit(facts: BuildFacts) -> list[str]:
    return [
        figure(
            draw_normalised(facts.normalised, facts.limit, "points"),
            "Histogram of normalised residuals",
            "Difference of each point from what its neighbours predict, in its standard deviations, beside the normal "
            "curve. A narrower histogram means that standard deviations are too large, a wider one that they are too "
            "small. The model's standard deviations follow the spread around each place, and what held-out blocks say.",
        ),
        figure(
            draw_covariance(facts.covariance),
            "Covariance functions",
            "Left: the fitted function of the whole area, and the range of eight in ten units. Right: covariance of "
            "the heights above a plane through each neighbourhood (dots), and what the fitted functions let expect of "
            "it after the same plane is taken away (line).",
        ),
        *([f"<p><strong>{text(facts.covariance.warning)}</strong></p>"] if facts.covariance.warning else []),
        *_held_out(facts),
    ]


def _held_out(facts: BuildFacts) -> list[str]:
    """What blocks that were held out say of the standard deviations."""
    if not facts.calibration:
        return []
    parts = [f"{100 * (c.furthest - c.nearest):.0f} %" for c in facts.bends]
    words = ("weakest", *("next" for _ in parts[2:]), "strongest")
    bends = [(f"{word} {part}", c) for word, part, c in zip(words, parts, facts.bends)]
    return [
        "<p>Blocks of heights were held out and predicted from all others. Their errors, divided by the standard "
        "deviations, have this spread (1: standard deviations are right; more: they are too small):</p>",
        _classes("distance to data", [(_distances(c), c) for c in facts.calibration]),
        "<p>The same by curvature of the ground. Nothing is corrected by it: at edges and crests without lines, "
        "standard deviations may be too small.</p>",
        _classes("curvature", bends),
    ]


def _distances(c: ClassFigures) -> str:
    return f"{c.nearest:.3g} to {c.furthest:.3g} m" if np.isfinite(c.furthest) else f"over {c.nearest:.3g} m"


def _classes(what: str, named: Sequence[tuple[str, ClassFigures]]) -> str:
    rows: list[list[str | Cell]] = []
    for where, c in named:
        after = f"{c.after:.2f}" if c.enough else "too few blocks"
        words = (_number(c.count), _number(c.blocks), f"{c.before:.2f}", after)
        rows.append([where, *(Cell(word, number=True) for word in words)])
    return table([what, "heights", "blocks", "as predicted", "as stated in the model"], rows)


def _effect(facts: BuildFacts) -> list[str]:
    effects = [effect for effect in facts.effects if np.isfinite(effect.differences).any()]
    if not effects:
        return ["<p>No point or line with heights lies on the surface.</p>"]
    rows = []
    for effect in facts.effects:
        d = effect.differences[np.isfinite(effect.differences)]
        figures = [_number(effect.count), _plain(effect.sigma)]
        if len(d):
            figures += [_plain(float(d.mean()), sign=True)]
            figures += [_plain(float(v)) for v in (np.sqrt((d**2).mean()), np.abs(d).max())]
        else:
            figures += ["–"] * 3
        row: list[str | Cell] = [effect.name, *(Cell(text, number=True) for text in figures)]
        rows.append(row)
    shown = sum(len(effect.differences) for effect in effects)
    every = sum(effect.count for effect in effects)
    sample = f" Shown are {_number(shown)} of {_number(every)} heights, evenly taken." if shown < every else ""
    return [
        table(["class", "number", "filter value m", "mean m", "root mean square m", "largest m"], rows),
        figure(
            draw_filter_histograms(effects),
            "Histograms of measured minus filtered heights",
            f"Measured minus filtered heights by class; gross errors are not among them.{sample}",
        ),
        figure(
            draw_filter_map(effects, facts.map),
            "Map of measured minus filtered heights",
            "Places of one colour that hang together are features that the filter took for noise, or errors of a whole "
            "series of measurements.",
        ),
    ]


def _gross(facts: BuildFacts) -> list[str]:
    if not facts.gross and not facts.suspects:
        return ["<p>None were sought.</p>" if facts.limit == 0 else "<p>None was found.</p>"]
    order = sorted(facts.gross, key=lambda g: -abs(g.normalised))
    parts = [
        figure(
            draw_gross(order, facts.suspects, facts.map),
            "Map of gross errors",
            "Where gross errors lie; the largest have the numbers of the list. Circles: suspects.",
        )
    ]
    if order:
        parts += [
            "<p>Points that contradict what their neighbours predict, alone or as a small group whose border breaks "
            "off all round. They were not used.</p>",
            *_errors(order),
        ]
    if facts.suspects:
        parts += [
            "<p>Suspects: small groups of points whose border breaks off in part, or that lie at the edge of the data. "
            "They were used; normalised residuals are those that each group has without itself. Is there a rock, a "
            "roof, a heap? Else take them out.</p>",
            *_errors(facts.suspects),
        ]
    return parts


def _errors(order: Sequence[PlottedError]) -> list[str]:
    rows: list[Sequence[str | Cell]] = [
        [
            Cell(str(k), number=True),
            g.name,
            *(Cell(text, number=True) for text in (f"{g.X:.2f}", f"{g.Y:.2f}", f"{g.height:.3f}")),
            Cell(_plain(g.difference, 3, sign=True), number=True),
            Cell(_plain(g.normalised, 1, sign=True), number=True),
        ]
        for k, g in enumerate(order[:MOST_ROWS], 1)
    ]
    parts = [table(["no.", "point", "X m", "Y m", "height m", "above the model m", "normalised residual"], rows)]
    if len(order) > MOST_ROWS:
        parts.append(f"<p>and {_number(len(order) - MOST_ROWS)} more.</p>")
    return parts


def _notes(facts: BuildFacts) -> list[str]:
    if not facts.notes:
        return ["<p>Nothing: lines meet in common points, no two points coincide.</p>"]
    rows: list[Sequence[str | Cell]] = []
    for kind in dict.fromkeys(note.kind for note in facts.notes):
        some = [note for note in facts.notes if note.kind == kind]
        for k, note in enumerate(some[:MOST_NOTES]):
            place = f"{note.X:.2f}, {note.Y:.2f}" if np.isfinite([note.X, note.Y]).all() else ""
            rows.append([kind if k == 0 else "", note.text, Cell(place, number=True)])
        if len(some) > MOST_NOTES:
            rows.append(["", f"and {_number(len(some) - MOST_NOTES)} more of this kind", ""])
    return [table(["kind", "finding", "X, Y m"], rows)]


def _record(facts: BuildFacts) -> list[str]:
    return [
        table(["input", ""], [list(row) for row in facts.inputs]),
        table(["setting", "value"], [list(row) for row in facts.settings]),
    ]


def _number(value: int) -> str:
    """With thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def _metres(value: float) -> str:
    return f"{value:.3f} m" if np.isfinite(value) else "–"


def _plain(value: float, digits: int = 3, sign: bool = False) -> str:
    if not np.isfinite(value):
        return "–"
    return (f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}").replace("-", "−")


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    return f"{int(seconds // 60)} min {seconds % 60:.0f} s"
