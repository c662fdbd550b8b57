"""The picture of tie points: which images hang together, and where the points lie in some of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import shortest_path

from photoplan.geometry.grid import Window
from photoplan.matching.features import Tracks, to_bytes
from photoplan.products.tie import TieImage, TieReport
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, RED, SKY, SOFT, figure_of, png, styled

#: Colours of points in two, three, four, and five or more images.
RAY_COLOURS = {2: ORANGE, 3: SKY, 4: BLUE, 5: GREEN}
_NAMES = 60
#: Longest side of the small copies, pixels.
_SIDE = 700


@styled
def draw_ties(report: TieReport) -> bytes | None:
    """Draw network and views; images are read again for small copies."""
    images, tracks = report.sources, report.found
    if tracks is None:
        return None
    points = np.bincount(tracks.image, minlength=len(images))
    shown = _spread(points)
    rows = -(-len(shown) // 2)
    fig = figure_of(9.0, 6.2 + 2.8 * rows)
    grid = fig.add_gridspec(rows + 1, 2, height_ratios=[6.0, *([2.8] * rows)])
    _network(fig.add_subplot(grid[0, :]), images, tracks, points)
    for k, number in enumerate(shown):
        _view(fig.add_subplot(grid[1 + k // 2, k % 2]), images[number], tracks, number)
    return png(fig)


def _network(axes: Any, images: Sequence[TieImage], tracks: Tracks, points: NDArray[np.int64]) -> None:
    joined, common = _common(tracks)
    positions = [image.position for image in images if image.position is not None]
    on_map = len(positions) == len(images)
    place = np.array(positions)[:, :2] if on_map else _places(len(images), joined, common)
    most = max(1, int(common.max(initial=1)))
    for k in np.argsort(common, kind="stable"):
        part = common[k] / most
        axes.plot(*place[joined[k]].T, color=BLUE, linewidth=0.3 + 4.0 * part, alpha=0.25 + 0.6 * part, zorder=1)
    alone = points == 0
    axes.scatter(*place[~alone].T, s=26, color=INK, zorder=2)
    if alone.any():
        axes.scatter(*place[alone].T, s=60, color=RED, marker="x", zorder=3, label="without connection")
        axes.legend(loc="upper right")
    if len(images) <= _NAMES:
        for image, at in zip(images, place):
            axes.annotate(image.name, at, (4, 4), textcoords="offset points", fontsize=7, color=INK)
    where = "by position on the map" if on_map else "by what they have in common"
    axes.set_title(f"Images, {where}; lines: common points, the widest {most}")
    axes.set_aspect("equal", adjustable="datalim")
    axes.ticklabel_format(useOffset=False, style="plain")
    if on_map:
        axes.set(xlabel="X, m", ylabel="Y, m")
    else:
        axes.set(xticks=[], yticks=[])


def _view(axes: Any, image: TieImage, tracks: Tracks, number: int) -> None:
    grey, factor = _small(image)
    here = tracks.image == number
    xy, rays = tracks.xy[here], tracks.rays[tracks.track[here]]
    edges = -0.5, grey.shape[1] * factor - 0.5, grey.shape[0] * factor - 0.5, -0.5
    axes.imshow(grey, cmap="gray", vmin=-40, vmax=295, interpolation="nearest", extent=edges)
    for many, colour in RAY_COLOURS.items():
        some = rays == many if many < 5 else rays >= 5
        label = f"{many} images" if many < 5 else "5 or more"
        if some.any():
            axes.scatter(*xy[some].T, s=7, color=colour, label=label, linewidths=0)
    axes.set(xlabel="column, px", ylabel="row, px")
    axes.grid(False)
    axes.set_title(f"{image.name}: {len(xy)} points", color=SOFT)
    if len(xy):
        axes.legend(loc="lower left", fontsize=6, markerscale=1.8, frameon=True)


def _spread(points: NDArray[np.int64], most: int = 4) -> list[int]:
    """Choose images to show, spread over those that have points."""
    some = np.flatnonzero(points)
    return sorted({int(some[int(i)]) for i in np.linspace(0, some.size - 1, min(most, some.size))})


def _common(tracks: Tracks) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of images with common tracks, and the number of these."""
    incidence = coo_matrix((np.ones(len(tracks), np.int64), (tracks.image, tracks.track))).tocsr()
    both = (incidence @ incidence.T).tocoo()
    upper = both.row < both.col
    return np.stack([both.row[upper], both.col[upper]], axis=1).astype(np.int64), both.data[upper].astype(np.int64)


def _places(count: int, joined: NDArray[np.int64], common: NDArray[np.int64]) -> NDArray[np.float64]:
    """Place images in the plane, the closer the more they share (classical scaling of path lengths)."""
    length = 1.0 / np.sqrt(np.maximum(common, 1))
    graph = coo_matrix((length, (joined[:, 0], joined[:, 1])), shape=(count, count)).tocsr()
    distance = shortest_path(graph, directed=False)
    known = distance[np.isfinite(distance)]
    distance = np.where(np.isfinite(distance), distance, 1.3 * known.max(initial=1.0))
    middle = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * middle @ distance**2 @ middle)
    return np.asarray(vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0)))


def _small(image: TieImage) -> tuple[NDArray[np.uint8], int]:
    """Read a small copy in strips; return it, and how many pixels along a side are one of it."""
    width, height = image.grey.size
    factor = max(1, -(-max(width, height) // _SIDE))
    columns, rows = width // factor, height // factor
    strips = [image.grey.reduced(Window(0, row, columns, min(64, rows - row)), factor) for row in range(0, rows, 64)]
    small = np.concatenate(strips)
    known = small[np.isfinite(small)]
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    return to_bytes(small, float(low), float(max(high, low + 1))), factor
