"""What the report shows of a test pattern."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.products.mtf.pattern_result import PatternResult
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.patterns.bar_curve import BarCurve, coltman_mtf
from photoplan.quality.patterns.siemens import StarMtf
from photoplan.quality.patterns.usaf import UsafBars, UsafResult
from photoplan.report.pattern_plots import Curve, Frame, Mark, PatternFacts, PolarCurve

#: Longest side of the picture, pixels.
_SIDE = 900


def pattern_facts(
    result: PatternResult, linearisation: str, pixel_um: float | None, picture: NDArray[np.float32] | None
) -> PatternFacts:
    """What the report shows; `picture` is the light of the window, one of `thinning` pixels, or None."""
    found = result.found
    head, rows = _table(result)
    curves = _curves(result)
    return PatternFacts(
        title=result.name,
        summary=result.lines()[0],
        head=head,
        rows=rows,
        notes=result.notes,
        linearisation=linearisation,
        curves=tuple(_usaf_curves(found)) if isinstance(found, UsafResult) else curves[0],
        polar=curves[1],
        picture=picture,
        marks=tuple(_marks(result)),
        frames=tuple(_frames(result)),
        pixel_um=pixel_um,
    )


def _table(result: PatternResult) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Header and rows."""
    found = result.found
    head: tuple[str, ...]
    if isinstance(found, StarMtf):
        head = ("direction", "MTF50 cy/px", "MTF10 cy/px", "from cy/px", "to cy/px")
        curves = [("all", found.mtf), *((f"{angle:.1f}°", curve) for angle, curve in found.directional.items())]
        return head, tuple(
            (name, _number(c.mtf50), _number(c.mtf10), f"{c.frequency[1]:.3f}", f"{c.frequency[-1]:.3f}")
            for name, c in curves
        )
    if isinstance(found, UsafResult):
        head = ("bars", "resolved up to", "LP/mm on the target", "cy/px", "contrast transfer")
        limits = (("horizontal", found.limit(horizontal=True)), ("vertical", found.limit(horizontal=False)))
        return head, tuple(_limit(name, last) for name, last in limits)
    head = ("bars", "cy/px", "direction", "contrast transfer", "MTF", *(["by Coltman"] if result.coltman else []))
    columns = [found.contrast, found.mtf, *([coltman_mtf(found.contrast)] if result.coltman else [])]
    return head, tuple(
        (
            str(k),
            f"{group.frequency:.4f}",
            f"{group.angle_deg:.1f}°",
            *(_value(column, k) for column in columns),
        )
        for k, group in enumerate(found.groups, 1)
    )


def _limit(name: str, last: UsafBars | None) -> tuple[str, ...]:
    if last is None:
        return (name, "none", "", "", "")
    place = f"group {last.group}, element {last.element}"
    return (name, place, f"{last.lp_mm:.2f}", f"{last.frequency:.3f}", f"{last.contrast:.3f} ± {last.sigma:.3f}")


def _number(value: float) -> str:
    return f"{value:.4f}" if isfinite(value) else "not reached"


def _value(curve: MtfCurve, k: int) -> str:
    """A value of a curve, whose first is that at frequency 0."""
    sigma = "" if curve.sigma is None or not isfinite(curve.sigma[k]) else f" ± {curve.sigma[k]:.4f}"
    return f"{curve.modulation[k]:.4f}{sigma}"


def _curves(result: PatternResult) -> tuple[tuple[Curve, ...], tuple[PolarCurve, ...]]:
    """Curves over all directions, and those of single ones."""
    curves, polar = [], []
    for name, (kind, curve) in result.curves().items():
        sigma = np.full(curve.frequency.size, np.nan) if curve.sigma is None else curve.sigma
        if " at " in name:
            polar.append(PolarCurve(float(name.split()[-1][:-1]), curve.frequency, curve.modulation))
        else:
            curves.append(Curve(name, kind, curve.frequency, curve.modulation, sigma, curve.frequency.size < 40))
    return tuple(curves), tuple(polar)


def _usaf_curves(found: UsafResult) -> Iterator[Curve]:
    for horizontal in (True, False):
        rows = [b for b in found.bars if b.horizontal == horizontal and isfinite(b.contrast)]
        f, c, s = np.array([[b.frequency, b.contrast, b.sigma] for b in rows]).reshape(-1, 3).T
        yield Curve(f"{'horizontal' if horizontal else 'vertical'} bars", "contrast", f, c, s, True)


def _marks(result: PatternResult) -> Iterator[Mark]:
    found, step = result.found, thinning(result.window)
    if isinstance(found, UsafResult):
        for bars in found.bars:
            label = f"{bars.group}.{bars.element}" if not bars.horizontal else ""
            yield Mark(bars.centre[0] / step, bars.centre[1] / step, label, bars.resolved)
    elif isinstance(found, StarMtf):
        yield Mark(found.centre[0] / step, found.centre[1] / step, "centre", True)


def _frames(result: PatternResult) -> Iterator[Frame]:
    """Outlines of the frequency groups of bars, numbered as in the table."""
    if isinstance(result.found, BarCurve):
        step = thinning(result.window)
        for number, part in enumerate(result.parts, 1):
            place = ((part.col - result.window.col) / step, (part.row - result.window.row) / step)
            yield Frame(*place, part.width / step, part.height / step, str(number))


def thinning(window: Window) -> int:
    """Of how many pixels along a side one is in the picture."""
    return max(1, -(-max(window.width, window.height) // _SIDE))
