"""What the images of a project show of the same ground, at a coarse resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import project as into_image
from photoplan.engine.execute import MOST_SOURCE_BYTES
from photoplan.engine.steps import steps
from photoplan.errors import GeometryError
from photoplan.events import Events
from photoplan.geometry.grid import MapGrid
from photoplan.io.naming import scratch
from photoplan.io.project.model import Project
from photoplan.plan.footprint import covered_tiles
from photoplan.plan.tiles import Tile, Tiles
from photoplan.products.balance.reference import Reference
from photoplan.products.orthophoto.look import Looked, look_at, two_figures
from photoplan.products.orthophoto.mosaic import refuse_mixed
from photoplan.products.orthophoto.shown import shown
from photoplan.products.run import question
from photoplan.project.scene import Scene, SceneAddress
from photoplan.radiometry.cells import BLOCK, SIDE, Cells, cells_of
from photoplan.surfaces.objects import painted_surface

#: Pixels of the map along the shorter side of an image, unless a resolution is chosen.
ACROSS = 256
#: Cells along the side of a tile.
_CELLS = BLOCK
#: Bytes that a band of an image takes in a cell that it shows till all is written.
_KEPT = 1200


@dataclass(frozen=True, eq=False)
class Survey:
    """The images that see terrain, and the map on which they are compared."""

    looked: tuple[Looked, ...]
    blind: tuple[str, ...]
    """A line for each image that sees none."""
    grid: MapGrid
    tiles: Tiles
    cameras: NDArray[np.int64]
    """Numbers of the images' cameras, (n,): images of one camera have one fall-off."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images."""
        return tuple(one.name for one in self.looked)

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Width and height of the images, (n, 2)."""
        return np.array([one.scene.reader.size for one in self.looked], np.int64)

    @property
    def tile_bytes(self) -> int:
        """What a tile takes at most that is looked at: a window of an image, and all images of the tile."""
        bands = self.looked[0].scene.reader.bands
        return 3 * MOST_SOURCE_BYTES + max(8 * bands * tile.pixels * len(tile.sources) for tile in self.tiles)

    @property
    def kept_bytes(self) -> int:
        """What the cells of all tiles take that are kept, and their adjustment."""
        rows = sum(tile.pixels * len(tile.sources) for tile in self.tiles) // SIDE**2
        return _KEPT * self.looked[0].scene.reader.bands * rows


def survey(project: Project, names: Sequence[str], resolution: float | None, events: Events) -> Survey:
    """Look at images, and choose the map; no pixel is read."""
    events.begin("planning", len(names), "images")
    looked, blind = look_at(project, names, False, events)
    if len(looked) < 2:
        seen = "one image sees" if looked else "no image sees"
        raise GeometryError(f"{seen} terrain, two at least are compared:\n  " + "\n  ".join(blind or ["the others"]))
    refuse_mixed(looked)
    if resolution is None:
        coarser = [one.look.gsd * max(1.0, min(one.scene.reader.size) / ACROSS) for one in looked]
        resolution = two_figures(float(np.median(coarser)))
    bounds = np.array([one.look.footprint.bounds for one in looked], float)
    extent = (*bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:].max(axis=0).tolist())
    grid = MapGrid.covering(extent, resolution, project.crs)
    taken = []
    for one in looked:
        surface = painted_surface(one.scene.surface)
        taken.append(covered_tiles(one.scene.camera, surface, grid, _CELLS * SIDE, one.look.footprint.bounds))
    # Images without a camera of the project, scenes of satellites for instance, are each their own.
    cameras = [getattr(project.any_image(one.name), "camera", None) or f"\n{one.name}" for one in looked]
    numbers = np.unique(cameras, return_inverse=True)[1].reshape(-1)
    return Survey(looked=tuple(looked), blind=tuple(blind), grid=grid, tiles=Tiles.shared(taken), cameras=numbers)


def sample(found: Survey, reference: Reference | None, workers: int, executor: str, events: Events, at: Path) -> Cells:
    """What all images show, cell by cell; tiles are looked at one by one and forgotten. `at`: folder of the product."""
    seen = [_Seen(tile, tuple(found.looked[row].scene.address for row in tile.sources)) for tile in found.tiles]
    job = _Sampling(found.grid, found.tiles.side, found.looked[0].scene.reader.bands, reference)
    events.begin("comparing", len(seen), "tiles")
    files = [file for one in found.looked for file in one.scene.files]
    asked = question(files if reference is None else [*files, reference.path], at)
    with steps("balance", workers, events, executor=executor, question=asked, scratch=partial(scratch, at)) as run:
        return Cells.joined(run(job, seen, pixels=lambda each: each.tile.pixels))


@dataclass(frozen=True)
class _Seen:
    """A tile as a worker gets it, and the images that see a part of it."""

    tile: Tile
    scenes: tuple[SceneAddress, ...]


@dataclass(frozen=True)
class _Sampling:
    """From a tile to its cells."""

    grid: MapGrid
    side: int
    bands: int
    reference: Reference | None

    def __call__(self, seen: _Seen) -> Cells:
        """Cells of a tile, with all images that see a part of it."""
        tile, scenes = seen.tile, {row: address.open() for row, address in zip(seen.tile.sources, seen.scenes)}
        window, values, valid, rows = tile.window, [], [], []
        for row, scene in scenes.items():
            made = shown(scene, self.grid, window, self.side)
            if made.values is not None and made.valid is not None:
                values.append(made.values.astype(np.float32))
                valid.append(made.valid)
                rows.append(row)
        if not rows:
            values, valid = [np.zeros((self.bands, 1, 1), np.float32)], [np.zeros((1, 1), bool)]
        known = None if self.reference is None or not rows else self.reference.pixels(self.grid, window)
        number = tile.index * _CELLS**2
        cells = cells_of(np.stack(values), np.stack(valid), np.array(rows or [0], np.int64), number, known)
        corner = np.array([window.col, window.row])
        return self._placed(replace(cells, place=cells.place + corner, uv=cells.uv + corner.astype(np.float32)), scenes)

    def _placed(self, cells: Cells, scenes: dict[int, Scene]) -> Cells:
        """Cells with their places in the images instead of the map; those that have none are left out."""
        uv = np.full_like(cells.uv, np.nan)
        XY = self.grid.to_map(cells.uv)
        for image in np.unique(cells.image).tolist():
            rows, scene = cells.image == image, scenes[image]
            heights = scene.surface.heights(XY[rows])
            uv[rows] = into_image(scene.camera, np.concatenate([XY[rows], heights[..., None]], axis=-1))
        return replace(cells, uv=uv).some(np.flatnonzero(np.isfinite(uv).all(axis=(1, 2))))
