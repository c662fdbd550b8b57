"""Blocks that `photoplan simulate --scene` renders, and how their products differ from what there is to see."""

from __future__ import annotations

import json
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
from photoplan.project.rendered import ProjectScene
from photoplan.surfaces.objects import ObjectSurface
from tools.command import inside

#: Grain of the pattern does not matter for what rays meet.
_ANY_GRAIN = 1.0
#: Grey values per pixel that an edge needs to be measured.
_CONTRAST = 7.0


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


def seen(project_path: Path, product: Path) -> Seen:
    """Rays from above to every pixel of a product, and from every image back to it.

    What is met within a tenth of a pixel is the place itself, as products have it (design/021).
    """
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
        off = np.full((len(xy), 3), np.inf)
        off[inside] = np.nan_to_num(view.hits(xy[inside]).XYZ - met.XYZ[inside], nan=np.inf)
        sees.append(np.linalg.norm(off, axis=1) < 0.1 * grid.resolution)
        missed.append(np.hypot(off[:, 0], off[:, 1]))
    shape = (grid.height, grid.width)
    return Seen(
        met.XYZ.reshape(*shape, 3),
        met.owner.reshape(shape),
        np.array(sees).reshape(-1, *shape),
        np.array(missed).reshape(-1, *shape),
        grid,
    )


def rendered_mosaic(scene: Path, product: Path, bounds: tuple[float, ...], resolution: float) -> list[str]:
    """Make a mosaic and what it needs, in the folder of the projects, by commands; its images by their rows."""
    where = ["--bounds", *bounds, "--resolution", resolution, "--workers", 2, "-q"]
    if not (scene.parent / "rendered").exists():
        said = inside("simulate", "--scene", scene, *where, "--seed", 63)
        assert said.code == 0, said.err
    output = scene.parent / product.stem
    said = inside("mosaic", product, *where, "--sources", "--no-quicklook", "--json", "--output", output)
    assert said.code == 0, said.err
    images: list[str] = json.loads(said.out)["products"][0]["images"]
    return images


@dataclass(frozen=True, eq=False)
class Judged:
    """How a mosaic differs from what there is to see."""

    visible: int
    """Pixels that an image sees."""
    right: float
    """Share of them that are painted by an image that sees them."""
    wrong: int
    """Pixels that are painted by an image that does not see them."""
    double: int
    """Those of them whose image shows there what is more than a pixel away on the map: it is there twice."""
    made: NDArray[np.float64]
    """Mean of the bands, shape (h, w)."""
    good: NDArray[np.bool_]
    """Pixels that show what is there, shape (h, w)."""


def judge(truth: Seen, mosaic: Path, images: list[str], names: list[str]) -> Judged:
    """Figures of a mosaic and its raster of sources; `images`: by their rows, `names`: as the project lists them."""
    with rasterio.open(mosaic.with_name(f"{mosaic.stem}_sources.tif")) as file:
        owner = file.read(1).astype(np.int64)
    painted = np.array([0, *(names.index(name) + 1 for name in images)])[owner]
    mine = np.take_along_axis(truth.sees, np.maximum(painted - 1, 0)[None], axis=0)[0] & (painted > 0)
    made, valid = pixels_of(mosaic)
    wrong = (painted > 0) & ~mine
    away = np.take_along_axis(truth.missed, np.maximum(painted - 1, 0)[None], axis=0)[0] > truth.grid.resolution
    return Judged(
        visible=int(truth.visible.sum()),
        right=float(mine[truth.visible].mean()),
        wrong=int(wrong.sum()),
        double=int((wrong & away).sum()),
        made=made,
        good=mine & valid,
    )


def pixels_of(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean of the bands, and where a raster has values."""
    with rasterio.open(path) as file:
        return file.read().astype(float).mean(axis=0), file.read_masks(1) > 0


def shifts(judged: Judged, true: NDArray[np.float64], truth: Seen, side: int = 17) -> NDArray[np.float64]:
    """Displacements (n, 2) in pixels of what windows show, where all of it is good and of one surface: by least
    squares."""
    even = np.abs(np.stack(np.gradient(truth.XYZ[..., 2]))).max(axis=0) < 2.5 * truth.grid.resolution
    good = judged.good & even
    a, b = (gaussian_filter(each, 1.0) for each in (judged.made, true))
    gy, gx = np.gradient(b)
    found = []
    for row in range(4, true.shape[0] - side - 4, side // 2):
        for col in range(4, true.shape[1] - side - 4, side // 2):
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
    judged: Judged, true: NDArray[np.float64], truth: Seen, lines: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Displacement across each line (2, 2), in pixels (column, row): of all that is within 3 pixels of it.

    NaN where there is no contrast, where pixels are missing, or where a third object comes near.
    """
    gy, gx = np.gradient(true)
    out = np.full(len(lines), np.nan)
    for k, (a, b) in enumerate(lines):
        along = (b - a) / np.linalg.norm(b - a)
        across = np.array([-along[1], along[0]])
        low = np.floor(np.minimum(a, b) - 3).astype(int).clip(0)
        high = np.ceil(np.maximum(a, b) + 3).astype(int) + 1
        if (low >= true.shape[::-1]).any() or (high <= 0).any():
            continue
        rows, cols = np.mgrid[low[1] : min(high[1], true.shape[0]), low[0] : min(high[0], true.shape[1])]
        at = np.stack([cols, rows], axis=-1) - a
        s, t = at @ along, at @ across
        inside = (np.abs(t) <= 3) & (s >= 0) & (s <= np.linalg.norm(b - a))
        r, c, t = rows[inside], cols[inside], t[inside]
        sides = [truth.owner[r[on], c[on]] for on in (t > 0.1, t < -0.1)]
        if min(len(side) for side in sides) < 15 or judged.good[r, c].mean() < 0.98:
            continue
        if any((side != np.median(side)).mean() > 0.02 for side in sides):
            continue
        g = gx[r, c] * across[0] + gy[r, c] * across[1]
        if np.abs(g[np.abs(t) <= 1.0]).mean() < _CONTRAST:
            continue
        design = np.stack([g, np.ones(len(g))], axis=1)
        out[k] = -np.linalg.lstsq(design, (judged.made - true)[r, c], rcond=None)[0][0]
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
