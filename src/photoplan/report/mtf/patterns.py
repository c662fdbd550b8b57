"""Report of test patterns: transfer against frequency, by direction, and where a target was found."""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.products.mtf.image import LightImage
from photoplan.products.mtf.pattern_result import PatternReport, PatternResult
from photoplan.products.mtf.patterns import MOST_PIXELS
from photoplan.quality.linearise import Linearisation
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.patterns.bar_curve import coltman_mtf
from photoplan.quality.patterns.siemens import StarMtf
from photoplan.quality.patterns.usaf import UsafBars, UsafResult
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, RED, SOFT, STYLE, axes_of, figure_of, mpl, png, styled
from photoplan.report.page import cells, figure, page, section, table, text

Array = NDArray[np.float64]

_WIDTH = 6.2
_COLOURS = (BLUE, RED, GREEN, ORANGE)
#: Modulations whose frequencies are shown by direction.
_LEVELS = (0.8, 0.5, 0.2, 0.1)
#: Longest side of a picture, pixels.
_SIDE = 900


@styled
def draw_curves(result: PatternResult) -> bytes:
    """Transfer against frequency, with two standard deviations."""
    curves = _curves(result)
    mtf = any(kind == "mtf" for _, kind, _ in curves)
    fig, axes = axes_of(_WIDTH, 3.5)
    for (name, kind, (frequency, value, sigma)), colour in zip(curves, _COLOURS):
        dashed = "--" if kind == "contrast" and mtf else "-"
        axes.plot(frequency, value, dashed, color=colour, linewidth=1.3, label=name)
        known = np.isfinite(sigma)
        if frequency.size < 40 or isinstance(result.found, UsafResult):
            axes.errorbar(frequency[known], value[known], 2.0 * sigma[known], fmt="o", color=colour,
                          markersize=3.2, linewidth=0.9)  # fmt: skip
        else:
            low, high = value - 2.0 * sigma, value + 2.0 * sigma
            axes.fill_between(frequency, low, high, color=colour, alpha=0.2, linewidth=0)
    longest = max([0.5, *(float(f.max()) for _, _, (f, _, _) in curves if f.size)])
    lowest = min([0.0, *(float(np.nanmin(v)) for _, _, (_, v, _) in curves if v.size)])
    axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=":")
    axes.set(xlim=(0, longest * 1.02), ylim=(max(lowest, -0.3) - 0.02, 1.12), xlabel="cycles per pixel",
             ylabel="modulation transfer" if mtf else "contrast transfer of bars")  # fmt: skip
    if result.pixel_um is not None and mtf:
        scale = 1000.0 / result.pixel_um
        top = axes.secondary_xaxis("top", functions=(lambda f: f * scale, lambda f: f / scale))
        top.set_xlabel("line pairs per mm")
    axes.legend(loc="upper right")
    return png(fig)


@styled
def draw_polar(star: StarMtf) -> bytes:
    """Frequencies at which the modulation falls to some levels, by direction."""
    fig = figure_of(_WIDTH, 4.2)
    axes = fig.add_subplot(projection="polar")
    angles = np.array(list(star.directional))
    for level, colour in zip(_LEVELS, _COLOURS):
        reach = np.array([curve.falls_to(level) for curve in star.directional.values()])
        if not np.isfinite(reach).any():
            continue
        turn = np.deg2rad(np.concatenate([angles, angles + 180.0, angles[:1]]))
        around = np.concatenate([reach, reach, reach[:1]])
        axes.plot(turn, around, "o-", color=colour, markersize=3, linewidth=1.2, label=f"modulation {level:g}")
    # Rows increase downwards: angles grow clockwise, as in the picture.
    axes.set_theta_direction(-1)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(labelsize=8)
    fig.legend(loc="outside right upper")
    return png(fig)


def draw_picture(result: PatternResult, light: NDArray[np.float32]) -> bytes:
    """The light of the pattern's window, thinned, and what was found in it."""
    rows, columns = light.shape
    step = _thinning(result.window)
    marks = _marks(result)
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        fig, axes = axes_of(_WIDTH, float(np.clip((_WIDTH - 0.5) * rows / columns + 0.5, 1.4, 8.5)))
        low, high = np.nanquantile(light, [0.005, 0.995])
        axes.imshow(light, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        for wanted, colour, name in ((True, GREEN, "resolved"), (False, RED, "not resolved")):
            some = [(x / step, y / step, label) for (x, y), label, resolved in marks if resolved == wanted]
            if some:
                axes.plot(*list(zip(*some))[:2], "+", color=colour, markersize=7, label=name)
            for x, y, label in some:
                axes.annotate(label, (x, y), (3, 3), textcoords="offset points", fontsize=6.5, color=colour)
        for number, part in enumerate(result.parts, 1):
            place = (part.col - result.window.col) / step - 0.5, (part.row - result.window.row) / step - 0.5
            side = part.width / step, part.height / step
            axes.add_patch(mpl.patches.Rectangle(place, *side, fill=False, edgecolor=RED))
            box = {"boxstyle": "square,pad=0.2", "facecolor": RED, "edgecolor": "none"}
            axes.annotate(str(number), place, (3, -3), textcoords="offset points", va="top", fontsize=8,
                          color="white", bbox=box)  # fmt: skip
        axes.set(xlabel="column px", ylabel="row px")
        if len({resolved for _, _, resolved in marks}) > 1:
            fig.legend(loc="outside upper right", ncols=2, labelcolor=INK)
        return png(fig)


def pattern_page(made: PatternReport) -> str:
    """The report as one HTML document; images are opened again for the pictures."""
    parts = []
    for result in (result for image in made.images for result in image.results):
        found = [f"<p>{text(result.lines()[0])}</p>", _table(result)]
        found += [f"<p>{text(note)}</p>" for note in result.notes]
        if any(frequency.size for _, _, (frequency, _, _) in _curves(result)):
            caption = "With two standard deviations; the dotted line is the Nyquist frequency."
            found.append(figure(draw_curves(result), "Transfer", caption))
        if isinstance(result.found, StarMtf) and result.found.directional:
            caption = "Frequency in cycles per pixel at which the modulation falls to a level, by its direction."
            found.append(figure(draw_polar(result.found), "Transfer by direction", caption))
        # Bars may lie far apart.
        if result.window.size <= MOST_PIXELS:
            light = _light(result, made.linearisation)
            found.append(figure(draw_picture(result, light), "Pattern", "What was found, marked at its place."))
        parts.append(section(result.name, found))
    kind = made.linearisation.describe() if made.images else ""
    return page("Test patterns", f"Modulation and contrast transfer of images; linearisation: {kind}", parts)


def _table(result: PatternResult) -> str:
    found = result.found
    head: tuple[str, ...]
    if isinstance(found, StarMtf):
        head = ("direction", "MTF50 cy/px", "MTF10 cy/px", "from cy/px", "to cy/px")
        curves = [("all", found.mtf), *((f"{angle:.1f}°", curve) for angle, curve in found.directional.items())]
        rows = [
            (name, _reached(c.mtf50), _reached(c.mtf10), f"{c.frequency[1]:.3f}", f"{c.frequency[-1]:.3f}")
            for name, c in curves
        ]
        return table(head, [cells(row, 1) for row in rows])
    if isinstance(found, UsafResult):
        head = ("bars", "resolved up to", "LP/mm on the target", "cy/px", "contrast transfer")
        limits = (("horizontal", found.limit(horizontal=True)), ("vertical", found.limit(horizontal=False)))
        return table(head, [cells(_limit(name, last), 1) for name, last in limits])
    head = ("bars", "cy/px", "direction", "contrast transfer", "MTF", *(["by Coltman"] if result.coltman else []))
    columns = [found.contrast, found.mtf, *([coltman_mtf(found.contrast)] if result.coltman else [])]
    return table(
        head,
        [
            cells((str(k), f"{group.frequency:.4f}", f"{group.angle_deg:.1f}°", *(_value(c, k) for c in columns)), 1)
            for k, group in enumerate(found.groups, 1)
        ],
    )


def _limit(name: str, last: UsafBars | None) -> tuple[str, ...]:
    if last is None:
        return (name, "none", "", "", "")
    place = f"group {last.group}, element {last.element}"
    return (name, place, f"{last.lp_mm:.2f}", f"{last.frequency:.3f}", f"{last.contrast:.3f} ± {last.sigma:.3f}")


def _reached(value: float) -> str:
    return f"{value:.4f}" if isfinite(value) else "not reached"


def _value(curve: MtfCurve, k: int) -> str:
    """A value of a curve, whose first is that at frequency 0."""
    sigma = "" if curve.sigma is None or not isfinite(curve.sigma[k]) else f" ± {curve.sigma[k]:.4f}"
    return f"{curve.modulation[k]:.4f}{sigma}"


def _curves(result: PatternResult) -> list[tuple[str, str, tuple[Array, Array, Array]]]:
    """Curves over all directions: name, ``mtf`` or ``contrast``, and frequency, value and standard deviation."""
    found = result.found
    if not isinstance(found, UsafResult):
        return [
            (name, kind, (c.frequency, c.modulation, np.full(c.frequency.size, np.nan) if c.sigma is None else c.sigma))
            for name, (kind, c) in result.curves().items()
            if " at " not in name
        ]
    curves = []
    for horizontal in (True, False):
        rows = [b for b in found.bars if b.horizontal == horizontal and isfinite(b.contrast)]
        f, c, s = np.array([[b.frequency, b.contrast, b.sigma] for b in rows]).reshape(-1, 3).T
        curves.append((f"{'horizontal' if horizontal else 'vertical'} bars", "contrast", (f, c, s)))
    return curves


def _marks(result: PatternResult) -> list[tuple[tuple[float, float], str, bool]]:
    """Places in the window with a label, and whether they are resolved."""
    found = result.found
    if isinstance(found, UsafResult):
        return [(b.centre, "" if b.horizontal else f"{b.group}.{b.element}", b.resolved) for b in found.bars]
    return [(found.centre, "centre", True)] if isinstance(found, StarMtf) else []


def _light(result: PatternResult, linearisation: Linearisation) -> NDArray[np.float32]:
    """Light of the pattern's window, one of some pixels."""
    image = LightImage.open(result.file, linearisation)
    step = _thinning(result.window)
    return np.asarray(image.picture(result.window, image.channels(None)[0]).grey[::step, ::step], np.float32)


def _thinning(window: Window) -> int:
    """Of how many pixels along a side one is in the picture."""
    return max(1, -(-max(window.width, window.height) // _SIDE))
