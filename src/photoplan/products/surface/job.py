"""A tile of a surface, as a worker makes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.framed import FramedCamera
from photoplan.engine.run import Made, Output
from photoplan.errors import InputError
from photoplan.events import stretch
from photoplan.geometry.frames import Frame
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.fingerprint import fingerprint
from photoplan.matching.facets.observe import View
from photoplan.matching.facets.pyramid import Pyramid
from photoplan.matching.facets.reconstruct import MARGIN, Scheme, reconstruct
from photoplan.matching.grey import GreyImage
from photoplan.plan.tiles import Tile
from photoplan.products.surface.settings import Bounds
from photoplan.products.surface.spread import counted
from photoplan.project.open_terrain import open_terrain
from photoplan.project.scene import Scene
from photoplan.project.scenes import ScenesAddress, surface_of
from photoplan.surfaces.objects import without_objects

_Doubles = NDArray[np.float64]

TILE = 336
"""Side of a tile of heights; those of grey values are as many times larger as they are finer."""
#: Grey facets along a part that is reconstructed at once, and blocks of image pyramids that are kept, bytes in all.
_PART, _KEPT = 1008, 256 << 20
MISFIT = 2.0
"""Heights around which residuals are so many times larger than expected are told of: they may be wrong."""
#: Bytes of a grey facet while it is adjusted: its equations, and what its pixel of each image needs.
_FACET, _PIXEL = 140, 60


@dataclass(frozen=True, kw_only=True)
class SurfaceJob:
    """All that a worker is told."""

    address: ScenesAddress
    grid: MapGrid
    scheme: Scheme
    start: str
    """See `SurfaceSettings.start`."""
    begun: tuple[str, str] | None = None
    """See `SurfacePlan.begun`."""
    residuals: bool = False
    """See `SurfaceSettings.residuals`."""
    frame: Frame | None = None
    """Of the target; None: the map."""
    bands: tuple[int, ...] = ()
    """See `SurfaceSettings.bands`."""
    finer: tuple[int, ...] = ()
    """See `SurfacePlan.finer`; empty: none is."""
    seen: float = 0.0
    """See `SurfacePlan.most`; 0: all."""

    @property
    def part(self) -> int:
        """Posts along a part of a tile that is reconstructed at once."""
        return max(16, min(TILE, _PART // self.scheme.ratio))

    @property
    def bytes(self) -> int:
        """Memory that a tile takes."""
        m, images = self.scheme.ratio, len(self.address.scenes)

        def facets(side: int, around: int = 0) -> int:
            return m**2 * (min(side, self.grid.width) + 2 * around) * (min(side, self.grid.height) + 2 * around)

        residuals = images if self.residuals else 0
        made = 4 * ((2 + residuals) * facets(TILE) + residuals * facets(self.part))
        each = _FACET + _PIXEL * (self.seen or images)
        return int(facets(self.part, MARGIN) * each) + 2 * _PART**2 * images + made

    def __call__(self, tile: Tile) -> Made:
        """Heights, their standard deviations, number of images, fit; grey values, theirs, perhaps residuals."""
        views = _views(self.address, self.finer, self.frame, self.grid.bounds, self.bands)
        start = _start(self.address, self.start, self.begun, self.grid.crs)
        crs, ground = self.grid.crs, self.address.scenes[0].open().ground
        outward = None if crs is None else ground.out_of_working(crs)
        window, m = tile.window, self.scheme.ratio
        shape, finest = (window.height, window.width), (m * window.height, m * window.width)
        heights, sigmas, fit = (np.full((1, *shape), np.nan, np.float32) for _ in range(3))
        count = np.zeros((1, *shape), np.uint8)
        grey, grey_sigmas = (np.full((1, *finest), np.nan, np.float32) for _ in range(2))
        residuals = np.full((len(views) if self.residuals else 0, *finest), np.nan, np.float32)
        sums, noise = np.zeros((len(views), 2)), np.zeros((len(views), 3))
        moves, parts, astray = np.zeros(self.scheme.coarsest + 1), 0, 0
        every = tuple(window.tiles(self.part))
        for k, part in enumerate(every):
            name = f"part {k + 1} of {len(every)}" if len(every) > 1 else ""
            with stretch(k / len(every), (k + 1) / len(every), name):
                found = reconstruct(views, self.grid, part, self.scheme, start, self.residuals)
            if found is None:
                continue
            at = (0, *part.slices(window))
            heights[at], sigmas[at], count[at], fit[at] = found.heights, found.sigmas, found.count, found.fit
            finer = Window(m * part.col, m * part.row, m * part.width, m * part.height)
            there = finer.slices(Window(m * window.col, m * window.row, m * window.width, m * window.height))
            grey[(0, *there)], grey_sigmas[(0, *there)] = found.grey, found.grey_sigmas
            if found.residuals is not None:
                residuals[(slice(None), *there)] = found.residuals
            sums, noise = sums + found.sums, noise + found.noise
            moves, parts, astray = moves + found.moves, parts + 1, astray + found.astray
        record = {
            "squares": sums[:, 0].tolist(),
            "redundancy": sums[:, 1].tolist(),
            "noise": noise.ravel().tolist(),
            "moves": moves.tolist(),
            "parts": parts,
            "sigmas": counted(sigmas),
            "heights": int(np.isfinite(sigmas).sum()),
            "astray": astray,
            "misfits": int((fit > MISFIT).sum()),
            "greys": [float(np.isfinite(grey).sum()), *(float(np.nansum(grey.astype(float) ** n)) for n in (1, 2))],
        }
        known, seen = np.isfinite(heights[0]), np.isfinite(grey[0])
        if outward is not None and outward.definition is not None:
            XY = self.grid.to_map(np.argwhere(known)[:, ::-1] + (window.col, window.row))
            heights[0, known] = outward(np.column_stack([XY, heights[0, known]]))
        layers: list[Output] = [
            (heights, known), (sigmas, known), (count, count[0] > 0), (fit, known), (grey, seen), (grey_sigmas, seen)
        ]  # fmt: skip
        if self.residuals:
            layers.append((residuals, seen & np.isfinite(residuals).any(axis=0)))
        return Made(tuple(layers) if known.any() else (None,) * len(layers), record)


@lru_cache(maxsize=2)
def _views(
    address: ScenesAddress, finer: tuple[int, ...], frame: Frame | None, bounds: Bounds, bands: tuple[int, ...]
) -> tuple[View, ...]:
    """The images and their pyramids, kept for the next tile; those of products before go."""
    kept = _KEPT // len(address.scenes)

    def view(scene: Scene, levels: int) -> View:
        camera = scene.camera if frame is None else FramedCamera(scene.camera, frame, bounds)
        return View(camera, Pyramid(GreyImage(scene.reader, bands=bands), kept=kept), levels)

    levels = finer or (0,) * len(address.scenes)
    return tuple(view(scene.open(), level) for scene, level in zip(address.scenes, levels, strict=True))


@lru_cache(maxsize=4)
def _start(
    address: ScenesAddress, start: str, begun: tuple[str, str] | None, crs: str
) -> Callable[[_Doubles], _Doubles]:
    """Heights with which a surface begins, in the system of the cameras; those of a user are in the one that their file
    states, or in the orientation's.
    """
    if begun is not None:
        path, digest = begun
        if fingerprint(path).digest != digest:
            raise InputError(f"{path}: has changed since the run was planned; plan it again")
        opened = open_terrain(Path(path)).in_crs(crs)[0]
        return _in_working(address, crs, opened.surface.heights, opened.height_system)
    if start == "terrain":
        return without_objects(surface_of(address)).heights
    height = float(start)
    return _in_working(address, crs, lambda XY: np.full(XY.shape[:-1], height))


def _in_working(
    address: ScenesAddress, crs: str | None, heights: Callable[[_Doubles], _Doubles], stated: str | None = None
) -> Callable[[_Doubles], _Doubles]:
    """Heights of a map, perhaps in a stated system, in that of the cameras; those over another target (no CRS) are in
    none."""
    step = None if crs is None else address.scenes[0].open().ground.into_working(crs, stated)
    if step is None or step.definition is None:
        return heights
    return lambda XY: step.where_defined(np.concatenate([XY, np.asarray(heights(XY))[..., None]], axis=-1))
