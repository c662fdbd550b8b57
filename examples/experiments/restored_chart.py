"""A photographed chart restored: the filter is measured at edges of its left half, the result at edges of its right.

``python examples/experiments/restored_chart.py ISO_DSC_300a.jpg FIGURE.png`` draws the figure of the page.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import rasterio
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.products.measured_filter import design_restoration
from photoplan.products.mtf.edges import LUMINANCE, LightImage, measure_edges
from photoplan.products.mtf.result import MeasuredEdge
from photoplan.products.restore import RestoreRequest, restore_images
from photoplan.project.steps import linearisation_of
from photoplan.quality.edges.response import EdgeMeasurement, measure_edge
from photoplan.requests.quality import MtfRequest

LIGHT = "srgb"
FREQUENCIES = np.linspace(0.0, 0.5, 51)


@dataclass(frozen=True)
class Outcome:
    """What restoration did to edges that the filter was not measured at."""

    method: str
    noise_gain: float
    before: NDArray[np.float64]
    """MTF of each edge at `FREQUENCIES`, shape (edges, 51)."""
    after: NDArray[np.float64]
    directions: tuple[str, ...]
    overshoot: float
    """Median of what the restored edges rise above or fall below their levels, parts of the contrast."""
    restored: Path

    def median(self, direction: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Median MTF before and after, of the edges of a direction."""
        of = np.array(self.directions) == direction
        return np.median(self.before[of], axis=0), np.median(self.after[of], axis=0)


def halves(chart: Path, folder: Path) -> tuple[Path, Path]:
    """Left and right half of an image as files."""
    with rasterio.open(chart) as file:
        pixels = file.read()
    middle = pixels.shape[2] // 2
    paths = []
    for name, part in (("left", pixels[:, :, :middle]), ("right", pixels[:, :, middle:])):
        path = folder / f"{name}.tif"
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=part.shape[2],
            height=part.shape[1],
            count=part.shape[0],
            dtype=part.dtype,
            photometric="RGB" if part.shape[0] == 3 else "MINISBLACK",
        ) as file:
            file.write(part)
        paths.append(path)
    return paths[0], paths[1]


def measured_again(path: Path, edge: MeasuredEdge) -> EdgeMeasurement | None:
    """The same edge, by the same pixels, in another image; None if it cannot be measured there."""
    image = LightImage.open(path, linearisation_of(LIGHT))
    (ax, ay), (bx, by) = edge.ends
    width, height = image.size
    left, top = max(0, int(min(ax, bx)) - edge.half), max(0, int(min(ay, by)) - edge.half)
    right, bottom = min(width, int(max(ax, bx)) + edge.half + 2), min(height, int(max(ay, by)) + edge.half + 2)
    grey = image.picture(Window(left, top, right - left, bottom - top), LUMINANCE).grey
    row, col = np.mgrid[top:bottom, left:right]
    length = np.hypot(bx - ax, by - ay)
    across = np.abs((col - ax) * (by - ay) - (row - ay) * (bx - ax)) / length
    along = ((col - ax) * (bx - ax) + (row - ay) * (by - ay)) / length
    try:
        return measure_edge(
            grey.astype(float), (across <= edge.half) & (along >= 0) & (along <= length), origin=(left, top)
        )
    except InputError:
        return None


def restore_chart(chart: Path, folder: Path, method: Literal["exact", "regularised"]) -> Outcome:
    """Measure a filter in the left half, restore the right half, measure its edges before and after."""
    left, right = halves(chart, folder)
    found = design_restoration(RestoreRequest((left,), linearisation=LIGHT, method=method))
    report = restore_images(
        RestoreRequest((right,), found.filter, folder / method, linearisation=LIGHT, overwrite=True)
    )
    restored = report.images[0].path
    measured = measure_edges(MtfRequest((right,), linearisation=LIGHT, least_snr=20.0))
    pairs = []
    for edge in measured.images[0].edges:
        if edge.aligned:  # lines between the grey patches: neither slanted nor plain edges
            continue
        one, other = measured_again(right, edge), measured_again(restored, edge)
        if one is not None and other is not None:
            pairs.append((one, other))
    curves = [[[e.mtf.at(f) for f in FREQUENCIES] for e in pair] for pair in pairs]
    before, after = np.array(curves).transpose(1, 0, 2)
    swing = float(np.median([max(other.overshoot, other.undershoot) for _, other in pairs]))
    directions = tuple(one.direction for one, _ in pairs)
    return Outcome(method, found.filter.noise_gain, before, after, directions, swing, restored)


def draw(chart: Path, picture: Path) -> None:
    """The zone plate of the chart before and after, and the MTF of other edges."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only the figure needs it

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        outcomes = [restore_chart(chart, folder, "exact"), restore_chart(chart, folder, "regularised")]
        fig = Figure(figsize=(12.0, 3.3), dpi=130, layout="constrained")
        axes = fig.subplots(1, 4, width_ratios=[1, 1, 1, 1.25])
        crop = np.s_[:, 505:640, 0:118]
        for ax, (title, path) in zip(
            axes[:3],
            [("image", folder / "right.tif"), *((o.method, o.restored) for o in outcomes)],
            strict=True,
        ):
            with rasterio.open(path) as file:
                ax.imshow(np.moveaxis(file.read()[crop], 0, -1), interpolation="nearest")
            ax.set_title(title, fontsize=9.5, loc="left")
            ax.set_axis_off()
        for outcome, colour in zip(outcomes, ("#cc3311", "#4477aa"), strict=True):
            before, after = np.median(outcome.before, axis=0), np.median(outcome.after, axis=0)
            if outcome.method == "exact":
                axes[3].plot(FREQUENCIES, before, color="#777777", label="image")
            axes[3].plot(FREQUENCIES, after, color=colour, label=f"{outcome.method}, noise × {outcome.noise_gain:.1f}")
        axes[3].set(xlabel="cycles/pixel", ylabel="modulation", ylim=(0, 1.25), xlim=(0, 0.5))
        axes[3].set_title("median MTF of edges in the right half", fontsize=9.5, loc="left")
        axes[3].legend(frameon=False, fontsize=8.5)
        axes[3].grid(color="#dddddd", linewidth=0.6)
        fig.savefig(picture)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
