"""How exactly a product lies, as a picture: the error of position over the map, with its error ellipses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photoplan.io.naming import write_atomically
from photoplan.io.quicklook import read_reduced
from photoplan.report.drawing import INK, STYLE, axes_of, load_matplotlib, png, round_down

#: Longest side of what is drawn, pixels; ellipses along it; length of the largest of them, part of their distance.
_SIDE, _ELLIPSES, _LARGEST = 900, 16, 0.8


def draw_accuracy(raster: Path) -> Path:
    """Draw an accuracy raster as a PNG beside it; replaces an older one.

    Raises
    ------
    UsageError
        matplotlib is not installed, or the folder cannot be written.
    InputError
        The raster cannot be read.
    """
    mpl = load_matplotlib("a picture of the accuracy", "leave `accuracy` out")
    bands, (left, bottom, right, top) = read_reduced(raster, max_side=_SIDE)
    radial = np.hypot(bands[0], bands[1])
    known = radial[np.isfinite(radial)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 1.0)
    with mpl.rc_context(STYLE):
        size = 8.0, float(np.clip(7.0 * (top - bottom) / (right - left), 3.0, 12.0))
        fig, ax = axes_of(*size)
        ax.grid(visible=False)
        shown = ax.imshow(radial, cmap="cividis", vmin=low, vmax=max(high, low + 1e-9),
                          extent=(left, right, bottom, top), interpolation="nearest")  # fmt: skip
        step = max(right - left, top - bottom) / _ELLIPSES
        longest = float(np.percentile(bands[3][np.isfinite(bands[3])], 98)) if known.size else 1.0
        scale = round_down(_LARGEST * step / 2 / max(longest, 1e-9))
        for y in np.arange(bottom + step / 2, top, step):
            for x in np.arange(left + step / 2, right, step):
                row = int((top - y) / (top - bottom) * radial.shape[0])
                col = int((x - left) / (right - left) * radial.shape[1])
                a, b, azimuth = bands[3:, row, col]
                for colour, width in ((INK, 2.2), ("white", 0.9)) if np.isfinite(a) else ():
                    ax.add_patch(mpl.patches.Ellipse((x, y), 2 * a * scale, 2 * b * scale, angle=90 - azimuth,
                                                     fill=False, edgecolor=colour, linewidth=width))  # fmt: skip
        fig.colorbar(shown, ax=ax, shrink=0.8, extend="both", label="standard deviation of position, m")
        ax.set(xlabel="X [m]", ylabel="Y [m]", aspect="equal")
        ax.set_title(f"{raster.name}: error ellipses {scale:.3g} times as large", color=INK)
        ax.ticklabel_format(useOffset=False, style="plain")
        ax.tick_params(axis="x", labelrotation=30)
        picture = raster.with_suffix(".png")
        write_atomically(picture, png(fig))
    return picture
