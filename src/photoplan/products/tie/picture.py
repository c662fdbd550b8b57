"""The picture beside a table of tie points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import shortest_path

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.io.disk import write_atomically
from photoplan.matching.grey import to_bytes
from photoplan.matching.tracks import Tracks
from photoplan.products.tie.inputs import TieImage
from photoplan.report.tie_plots import TieFacts, TiePlots, TieView, spread_views

#: Longest side of the small copies, pixels.
_SIDE = 700


def draw_ties(path: Path, images: Sequence[TieImage], tracks: Tracks) -> Path | None:
    """Write the picture; None if matplotlib is not installed."""
    try:
        plots = TiePlots()
    except UsageError:
        return None
    count = len(images)
    joined, common = _common(tracks)
    points = np.bincount(tracks.image, minlength=count)
    on_map = all(image.position is not None for image in images)
    if on_map:
        place = np.array([image.position for image in images])[:, :2]
    else:
        place = _places(count, joined, common)
    views = tuple(_view(images[k], tracks, k) for k in spread_views(count, points.tolist()))
    names = tuple(image.name for image in images)
    write_atomically(path, plots.ties(TieFacts(names, place, on_map, joined, common, points, views)))
    return path


def _common(tracks: Tracks) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of images with common tracks, and their number."""
    incidence = coo_matrix((np.ones(len(tracks), np.int64), (tracks.image, tracks.track))).tocsr()
    both = (incidence @ incidence.T).tocoo()
    upper = both.row < both.col
    return np.stack([both.row[upper], both.col[upper]], axis=1).astype(np.int64), both.data[upper].astype(np.int64)


def _places(count: int, joined: NDArray[np.int64], common: NDArray[np.int64]) -> NDArray[np.float64]:
    """A plane drawing in which images lie the closer the more they share (classical scaling of path lengths)."""
    length = 1.0 / np.sqrt(np.maximum(common, 1))
    graph = coo_matrix((length, (joined[:, 0], joined[:, 1])), shape=(count, count)).tocsr()
    distance = shortest_path(graph, directed=False)
    known = distance[np.isfinite(distance)]
    distance = np.where(np.isfinite(distance), distance, 1.3 * known.max(initial=1.0))
    middle = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * middle @ distance**2 @ middle)
    return np.asarray(vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0)))


def _view(image: TieImage, tracks: Tracks, k: int) -> TieView:
    """A small copy, read in strips."""
    width, height = image.grey.size
    factor = max(1, -(-max(width, height) // _SIDE))
    columns, rows = width // factor, height // factor
    strips = [image.grey.reduced(Window(0, row, columns, min(64, rows - row)), factor) for row in range(0, rows, 64)]
    small = np.concatenate(strips)
    known = small[np.isfinite(small)]
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    here = tracks.image == k
    xy = (tracks.xy[here] + 0.5) / factor - 0.5
    grey = to_bytes(small, float(low), float(max(high, low + 1)))
    return TieView(image.name, grey, xy, tracks.rays[tracks.track[here]])
