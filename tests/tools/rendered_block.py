"""Blocks that `photoplan simulate --scene` renders, and how their products differ from what there is to see."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from photoplan.cameras.base import project as project_points
from photoplan.geometry.grid import MapGrid
from photoplan.io.project.file import load_project
from photoplan.products.simulate.scene import ProjectScene
from photoplan.surfaces.objects import ObjectSurface

#: Grain of the pattern does not matter for what rays meet.
_ANY_GRAIN = 1.0


@dataclass(frozen=True)
class Flight:
    """Strips of images over a place."""

    middle: tuple[float, float]
    height: float
    """Of the cameras."""
    base: tuple[float, float]
    """Between images of a strip, and between strips."""
    count: tuple[int, int]
    size: tuple[int, int] = (1200, 900)
    focal: float = 900.0
    tilt: float = 1.5
    """Standard deviation of ω and φ, degrees."""


def write_project(folder: Path, crs: str, terrain: str, objects: str, flight: Flight, name: str = "project") -> Path:
    """A project whose images are yet to be rendered, in `folder/rendered`."""
    rng = np.random.default_rng(5)
    width, height = flight.size
    lines = [
        f'format = 1\ncrs = "{crs}"\n\n[terrain]\n{terrain}\nheight_system = "same"\n\n[orientation]',
        'height_system = "same"\n\n[cameras.c]\ntype = "frame"',
        f"size = [{width}, {height}]\nfocal_px = {flight.focal}\n{objects}",
    ]
    number = 0
    for row in range(flight.count[1]):
        for col in range(flight.count[0]):
            number += 1
            x = flight.middle[0] + (col - (flight.count[0] - 1) / 2) * flight.base[0]
            y = flight.middle[1] + (row - (flight.count[1] - 1) / 2) * flight.base[1]
            omega, phi = rng.normal(0, flight.tilt, 2)
            kappa = 3.0 if row % 2 == 0 else 182.0
            lines.append(
                f'[[images]]\nname = "i{number}"\nfile = "rendered/i{number}.tif"\ncamera = "c"\n'
                f"center = [{x:.3f}, {y:.3f}, {flight.height:.3f}]\nangles = [{omega:.4f}, {phi:.4f}, {kappa}]\n"
            )
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines))
    return path


@dataclass(frozen=True, eq=False)
class Seen:
    """What there is at the pixels of a product, and which images see it."""

    XYZ: NDArray[np.float64]
    """Shape (h, w, 3)."""
    owner: NDArray[np.int64]
    """Object, 0: ground; shape (h, w)."""
    sees: NDArray[np.bool_]
    """Shape (images, h, w)."""
    missed: NDArray[np.float64]
    """Distance on the map between a place and what the image's ray there meets, shape (images, h, w), metres; inf
    outside the image."""
    grid: MapGrid

    @property
    def visible(self) -> NDArray[np.bool_]:
        """By any image."""
        return self.sees.any(axis=0)


def seen(project_path: Path, product: Path, near: float = 0.01) -> Seen:
    """Rays from above to every pixel of a product, and from every image back to it."""
    project = load_project(project_path)
    scene = ProjectScene.of(project, None, _ANY_GRAIN, 0, 1)
    with rasterio.open(product) as file:
        grid = MapGrid(file.transform.c, file.transform.f, file.transform.a, file.width, file.height, project.crs)
    v, u = np.mgrid[: grid.height, : grid.width].astype(float)
    met = scene.from_above(grid).hits(np.stack([u, v], axis=-1).reshape(-1, 2))
    sees, missed = [], []
    for image in project.images:
        view = scene.seen_by(image.name)
        xy = project_points(view.camera, met.XYZ)  # type: ignore[arg-type]
        inside = ((xy >= -0.5) & (xy <= np.array(view.size) - 0.5)).all(axis=1)
        far = np.full(len(xy), np.inf)
        back = view.hits(xy[inside]).XYZ - met.XYZ[inside]
        far[inside] = np.where(np.isnan(back[:, 0]), np.inf, np.linalg.norm(back, axis=1))
        sees.append(far < near)
        missed.append(far)
    shape = (grid.height, grid.width)
    return Seen(
        met.XYZ.reshape(*shape, 3),
        met.owner.reshape(shape),
        np.array(sees).reshape(-1, *shape),
        np.array(missed).reshape(-1, *shape),
        grid,
    )


@dataclass(frozen=True)
class Judged:
    """How a mosaic differs from what there is to see."""

    visible: int
    """Pixels that an image sees."""
    right: float
    """Share of them that are painted by an image that sees them."""
    wrong: int
    """Pixels that are painted by an image that does not see them, which shows something else there: ground or roof that
    is there twice."""
    empty: int
    """Visible pixels that are empty."""


def judge(truth: Seen, sources: Path, images: list[str], names: list[str]) -> tuple[Judged, NDArray[np.int64]]:
    """Figures of a mosaic from its raster of sources; `images`: as its record lists them, `names`: as the project."""
    with rasterio.open(sources) as file:
        owner = file.read(1).astype(np.int64)
    rows = np.array([0, *(names.index(name) + 1 for name in images)])
    painted = rows[owner]
    mine = np.take_along_axis(truth.sees, np.maximum(painted - 1, 0)[None], axis=0)[0] & (painted > 0)
    visible = truth.visible
    figures = Judged(
        visible=int(visible.sum()),
        right=float(mine[visible].mean()),
        wrong=int(((painted > 0) & ~mine).sum()),
        empty=int((visible & (painted == 0)).sum()),
    )
    return figures, np.where(mine, painted, 0)


def pixels_of(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean of the bands, and where a raster has values."""
    with rasterio.open(path) as file:
        return file.read().astype(float).mean(axis=0), file.read_masks(1) > 0


def shifts(
    made: NDArray[np.float64], true: NDArray[np.float64], good: NDArray[np.bool_], side: int = 17
) -> NDArray[np.float64]:
    """Displacements (n, 2) in pixels of what windows show, where all their pixels are good: by least squares."""
    a, b = (gaussian_filter(each, 1.0) for each in (made, true))
    gy, gx = np.gradient(b)
    found = []
    for row in range(4, made.shape[0] - side - 4, side // 2):
        for col in range(4, made.shape[1] - side - 4, side // 2):
            at = slice(row, row + side), slice(col, col + side)
            if not good[row - 4 : row + side + 4, col - 4 : col + side + 4].all():
                continue
            g = np.stack([gx[at].ravel(), gy[at].ravel(), np.ones(side**2)], axis=1)
            normal = g.T @ g
            if np.linalg.eigvalsh(normal[:2, :2])[0] < 2.0 * side**2:
                continue
            found.append(-np.linalg.solve(normal, g.T @ (a - b)[at].ravel())[:2])
    return np.array(found).reshape(-1, 2)


def edge_shifts(
    made: NDArray[np.float64],
    true: NDArray[np.float64],
    good: NDArray[np.bool_],
    lines: list[NDArray[np.float64]],
    reach: float = 3.0,
) -> NDArray[np.float64]:
    """Displacement across each line (2, 2), in pixels (column, row): of all that is within `reach` pixels of it.

    NaN where there is no contrast, or where pixels are missing.
    """
    gy, gx = np.gradient(true)
    out = np.full(len(lines), np.nan)
    for k, (a, b) in enumerate(lines):
        along = (b - a) / np.linalg.norm(b - a)
        across = np.array([-along[1], along[0]])
        low = np.floor(np.minimum(a, b) - reach).astype(int).clip(0)
        high = np.ceil(np.maximum(a, b) + reach).astype(int) + 1
        rows, cols = np.mgrid[low[1] : min(high[1], true.shape[0]), low[0] : min(high[0], true.shape[1])]
        at = np.stack([cols, rows], axis=-1) - a
        s, t = at @ along, at @ across
        inside = (np.abs(t) <= reach) & (s >= 3) & (s <= np.linalg.norm(b - a) - 3)
        r, c = rows[inside], cols[inside]
        if inside.sum() < 30 or good[r, c].mean() < 0.98:
            continue
        g = gx[r, c] * across[0] + gy[r, c] * across[1]
        near = np.abs(t[inside]) <= 1.0
        if np.abs(g[near]).mean() < 6.0:
            continue
        design = np.stack([g, np.ones(len(g))], axis=1)
        out[k] = -np.linalg.lstsq(design, (made - true)[r, c], rcond=None)[0][0]
    return out


def upper_edges(surface: ObjectSurface, grid: MapGrid, shortest: float) -> list[NDArray[np.float64]]:
    """Edges of roofs and decks that lie free above what is beside them, (2, 2) in pixels of a grid."""
    faces = surface.faces
    flat = np.abs(faces.normals(np.arange(len(faces)), np.tile([0.0, 0.0, -1.0], (len(faces), 1)))[:, 2]) > 0.3
    shapes: dict[int, list[shapely.Polygon]] = {}
    for corners, owner in zip(faces.corners[flat], faces.owner[flat]):
        shapes.setdefault(int(owner), []).append(shapely.Polygon(corners[:, :2]))
    lines = []
    for parts in shapes.values():
        union = shapely.simplify(shapely.union_all([p.buffer(1e-4) for p in parts]), 0.01)
        for polygon in shapely.get_parts(union):
            for ring in (polygon.exterior, *polygon.interiors):
                xy = np.asarray(ring.coords)
                for a, b in pairwise(xy):
                    if np.hypot(*(b - a)) < shortest:
                        continue
                    across = np.array([-(b - a)[1], (b - a)[0]]) / np.hypot(*(b - a))
                    middle = (a + b) / 2
                    left, right = surface.heights(np.stack([middle + 0.1 * across, middle - 0.1 * across]))
                    if abs(left - right) > 1.0:
                        lines.append(grid.to_pixel(np.stack([a, b])))
    return lines
