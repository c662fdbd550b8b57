"""Any image onto any target, from arrays or files into an array: the whole chain as one function."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Projection
from photoplan.engine.execute import ArrayReader, Painted, Reader, Source, joined, render
from photoplan.engine.executors import Outcome, Workers, executor_factory, run_tiles
from photoplan.errors import PhotoplanError, PhotoplanWarning, UsageError
from photoplan.geometry.crs import crs_label, parse_crs, require_projected_metres
from photoplan.geometry.grid import MapGrid, Placement
from photoplan.io.disk import Nodata
from photoplan.io.product import ProductFile
from photoplan.io.raster import RasterReader, pixels_of_dataset
from photoplan.kernels.weights import KERNELS
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Tiles
from photoplan.plan.product import ProductPlan
from photoplan.plan.sources import GivenOwners
from photoplan.project.ground import open_terrain
from photoplan.public import described, file_of
from photoplan.surfaces.base import LevelSurface, Surface
from photoplan.targets.map import MapTarget, Target

_SAVED_TILE = 512


@dataclass(frozen=True, eq=False)
class Raster:
    """Pixels in memory, which of them are valid, and where they lie."""

    values: NDArray[Any]
    """(bands, height, width); 0 where invalid."""
    valid: NDArray[np.bool_]
    """(height, width), True = valid."""
    placement: Placement
    """Size and place; `placement.affine` and `placement.crs` are what other packages ask for."""
    owner: NDArray[np.uint16] | None = None
    """(height, width): number of the source, from one, that painted each pixel, 0 = none; None: there is one source."""
    residual: float = 0.0
    """Worst difference to the strict projection, pixels of the source."""

    def __post_init__(self) -> None:
        width, height = self.placement.size
        if self.values.ndim != 3 or self.values.shape[1:] != (height, width) or self.valid.shape != (height, width):
            raise UsageError(
                f"values of shape {self.values.shape}, validity of shape {self.valid.shape}; needed are "
                f"(bands, {height}, {width}) and ({height}, {width}), the size of the placement"
            )

    def to_xarray(self) -> Any:
        """An `xarray.DataArray` (band, y, x) of floats with NaN where invalid, with coordinates of the pixel centres.

        The placement's CRS stands in its attributes, and as `spatial_ref` in the way of the CF conventions.

        Raises
        ------
        UsageError
            xarray is not installed, or the raster is turned in its plane, so that rows and columns have no coordinates.
        """
        try:
            import xarray  # noqa: PLC0415  (an optional package)
        except ImportError as error:
            raise UsageError("xarray is not installed; install it with: pip install 'photoplan[arrays]'") from error
        _, b, _, d, _, _ = self.placement.coefficients
        if b or d:
            raise UsageError(f"a raster with the transform {self.placement.coefficients} is turned; save it instead")
        width, height = self.placement.size
        x = self.placement.to_plane(np.stack([np.arange(width), np.zeros(width)], axis=-1))[:, 0]
        y = self.placement.to_plane(np.stack([np.zeros(height), np.arange(height)], axis=-1))[:, 1]
        kept = self.values.astype(np.result_type(self.values, np.float32), copy=False)
        array = xarray.DataArray(
            np.where(self.valid, kept, np.nan),
            coords={"band": np.arange(1, len(kept) + 1), "y": y, "x": x},
            dims=("band", "y", "x"),
            attrs={"crs": self.placement.crs or "", "unit": self.placement.unit},
        )
        crs = {} if self.placement.crs is None else {"crs_wkt": parse_crs(self.placement.crs).to_wkt()}
        return array.assign_coords(spatial_ref=((), 0, crs))

    def save(
        self, path: Path | str, *, nodata: Nodata = "auto", compress: str = "deflate", overwrite: bool = False
    ) -> Path:
        """Write a cloud-optimised GeoTIFF.

        Parameters
        ----------
        nodata : float, ``"mask"`` or ``"auto"``
            See `photoplan.io.product.ProductFile`.
        compress : str
            ``none``, ``deflate``, ``zstd``, ``lzw`` or ``jpeg``.

        Raises
        ------
        UsageError
            The file exists, or type or options are not allowed.
        ResourceError
            The disk is full.
        """
        file = ProductFile(
            Path(path),
            self.placement,
            len(self.values),
            self.values.dtype,
            run_key="saved from memory",
            nodata=nodata,
            compress=compress,
            tile=_SAVED_TILE,
            overwrite=overwrite,
        )
        with file:
            for index, window in enumerate(file.windows):
                part = window.slices(self.placement.window)
                file.append(index, np.ascontiguousarray(self.values[:, part[0], part[1]]), self.valid[part])
            file.complete()
        return Path(path)


def rectify(
    source: Any,
    camera: Projection | Sequence[Projection],
    target: Target | MapGrid,
    surface: Surface | Path | str | float,
    *,
    owner: ArrayLike | None = None,
    kernel: str = "bicubic",
    tolerance: float = 0.02,
    tile: int = 512,
    workers: int = 1,
) -> Raster:
    """Resample an image, or several, onto a target.

    Parameters
    ----------
    source : array, path, rasterio dataset or reader, or a list of them
        Arrays have the shape (height, width) or (bands, height, width) and the type uint8, uint16, int16 or float32;
        a masked array's mask and NaN are invalid. Files are read by windows, in overviews where the target is coarse.
        Images of one call have the same bands and type.
    camera : Projection, or a list of them
        One for each source, for images of its size.
    target : Target or MapGrid
        Where the pixels of the result lie: for an orthophoto a `MapGrid`, or any object with `window`,
        `to_ground` and `placement`.
    surface : Surface, path or number
        What gives the depth h of the target's pixels; a path is a height raster or terrain model, whose heights are
        taken as they are; a number is a level.
    owner : array of integers, optional
        Number of the source, from one, that paints each pixel, shape (height, width) of the target; 0: none. Needed
        with several sources.
    kernel : str
        ``nearest``, ``bilinear``, ``bicubic`` (a = −0.5), ``bicubic-1`` (a = −1) or ``lanczos3``.
    tolerance : float
        Largest difference to the strict projection, pixels of the source.
    tile : int
        Side of the parts that are computed at once, pixels.
    workers : int
        Threads.

    Returns
    -------
    Raster
        0 and not valid where no source shows the surface.

    Raises
    ------
    UsageError
        Arguments that do not fit each other.
    InputError
        A file cannot be used.
    """
    if kernel not in KERNELS:
        raise UsageError(f"kernel {kernel!r}; allowed are {', '.join(KERNELS)}")
    if not (tolerance > 0 and tile >= 1 and workers >= 1):
        given = f"tolerance {tolerance}, tile {tile}, workers {workers}"
        raise UsageError(f"{given}; needed are a positive number of pixels and whole numbers from 1")
    sources = _sources(source, camera)
    place = MapTarget(target) if isinstance(target, MapGrid) else target
    if not all(hasattr(place, name) for name in ("window", "to_ground", "placement")):
        raise UsageError(f"target: {described(target)}; give a MapGrid, such as MapGrid.covering(bounds, 0.1, crs), or "
                         "another target")  # fmt: skip
    if isinstance(target, MapGrid) and target.crs is not None:
        require_projected_metres(target.crs, "target: CRS")
    names = tuple(f"source {k}" for k in range(1, len(sources) + 1))
    plan = ProductPlan(
        name="rectified",
        sources=names,
        target=place,
        rule=AnchorRule.of(kernel, tolerance),
        tiles=Tiles.every(place.window, tile, len(names)),
        owners=None if owner is None else GivenOwners(_owners(owner, len(names), place.placement.size)),
    )
    work = partial(render, plan, sources=sources, surface=_surface(surface, place), kernel=kernel)
    made = _collected(plan, sources[0].reader, work, workers)
    if not made.valid.any():
        warnings.warn(PhotoplanWarning(_why_empty(sources, place)), stacklevel=2)
    return made


def _why_empty(sources: Sequence[Source], target: Target) -> str:
    """A sentence for a result without a valid pixel: where the target lies, and where cameras stand."""
    uv = np.array([(0.0, 0.0), (target.window.width - 1.0, target.window.height - 1.0)])
    ends = np.asarray(target.to_ground(np.column_stack([uv, np.zeros(2)])), float)[:, :2]
    center = getattr(sources[0].camera, "center", None)
    stands = "" if center is None else f"; the first camera stands at X {center[0]:.0f}, Y {center[1]:.0f}"
    return (
        "no pixel of the result is valid: no source shows the surface there. The target reaches from "
        f"{ends[0, 0]:.0f}, {ends[0, 1]:.0f} to {ends[1, 0]:.0f}, {ends[1, 1]:.0f}{stands}; are both in one CRS and "
        "height system?"
    )


def _collected(plan: ProductPlan, reader: Reader, work: Any, workers: int) -> Raster:
    with Workers(executor_factory("threads", workers), workers) as pool:
        parts = ((each.task.window, _painted(each)) for each in run_tiles(plan.tiles, work, pool, pool.in_flight))
        whole = joined(plan.target.window, parts, reader)
    assert whole.values is not None and whole.valid is not None
    owner = np.zeros_like(whole.valid, np.uint16) if plan.owners is not None and whole.owner is None else whole.owner
    return Raster(
        values=whole.values, valid=whole.valid, placement=plan.target.placement, owner=owner, residual=whole.residual
    )


def _painted(outcome: Outcome) -> Painted:
    if outcome.error is not None:
        raise PhotoplanError(f"tile {outcome.task.index}: {outcome.error}")
    assert isinstance(outcome.result, Painted)
    return outcome.result


def _sources(source: Any, camera: Projection | Sequence[Projection]) -> list[Source]:
    several = isinstance(camera, list | tuple)
    cameras: list[Any] = list(camera) if isinstance(camera, list | tuple) else [camera]
    if several and not isinstance(source, list | tuple):
        raise UsageError(f"{len(cameras)} cameras and one source, {described(source)}; give a list of sources, too")
    given = list(source) if several else [source]
    if not cameras or len(given) != len(cameras):
        raise UsageError(f"{len(given)} sources and {len(cameras)} cameras; each source needs its own camera")
    for each in cameras:
        if not (hasattr(each, "project_homogeneous") and hasattr(each, "size")):
            raise UsageError(
                f"camera: {described(each)}; give a camera with its orientation, such as photoplan.FrameCamera, or a "
                "list of them (images of a project are rectified by photoplan.plan_orthophotos)"
            )
    sources = [Source(c, _reader(s)) for s, c in zip(given, cameras)]
    for number, each in enumerate(sources, 1):
        if tuple(each.reader.size) != tuple(each.camera.size):
            if isinstance(each.reader, ArrayReader) and each.reader.image.shape[:2] == tuple(each.camera.size)[::-1]:
                raise UsageError(
                    f"source {number} has the shape {each.reader.image.shape}; needed is (bands, height, width): give "
                    "array.transpose(2, 0, 1)"
                )
            raise UsageError(
                f"source {number} has {each.reader.size[0]} × {each.reader.size[1]} pixels, its camera has "
                f"{each.camera.size[0]} × {each.camera.size[1]}; a cropped or scaled image needs a camera of its own"
            )
        first = sources[0].reader
        if (each.reader.bands, each.reader.dtype) != (first.bands, first.dtype):
            raise UsageError(
                f"source {number} has {each.reader.bands} bands of {each.reader.dtype}, the first {first.bands} of "
                f"{first.dtype}; images of one result must be alike"
            )
    return sources


def _reader(source: Any) -> Reader:
    """What the engine reads, from whatever holds pixels."""
    if isinstance(source, Path | str):
        return RasterReader(Path(source))
    pixels = source if isinstance(source, np.ndarray) else pixels_of_dataset(source)
    if isinstance(pixels, np.ndarray):
        return ArrayReader.of(pixels)
    if pixels is not None:
        return pixels
    if hasattr(source, "dims") and hasattr(source, "values") and not hasattr(source, "data_vars"):
        return ArrayReader.of(_of_xarray(source))
    if isinstance(source, Reader):
        return source
    if hasattr(source, "__array__") and not hasattr(source, "data_vars"):
        return ArrayReader.of(np.asarray(source))
    raise UsageError(
        f"source: {described(source)}; give an array or xarray.DataArray, a path, a rasterio dataset or a reader"
    )


def _of_xarray(source: Any) -> NDArray[Any]:
    """Pixels (bands, height, width) of an xarray.DataArray; its values for none are masked."""
    if not {"y", "x"} <= set(source.dims) or source.ndim > 3:
        raise UsageError(f"source: DataArray with dimensions {source.dims}; needed are (band, y, x) or (y, x)")
    values = np.asarray(source.transpose(..., "y", "x").values)
    names = [(source.attrs, name) for name in ("_FillValue", "missing_value", "nodata", "nodatavals")]
    names += [(source.encoding, name) for name in ("_FillValue", "missing_value")]
    nodata = next((stated[name] for stated, name in names if stated.get(name) is not None), None)
    return values if nodata is None else np.ma.masked_where(np.isin(values, np.ravel(nodata)), values)


def _owners(owner: ArrayLike, count: int, size: tuple[int, int]) -> NDArray[np.uint16]:
    numbers = np.asarray(owner)
    if numbers.dtype.kind not in "iub" or (numbers.size and not (numbers.min() >= 0 and numbers.max() <= count)):
        raise UsageError(f"owners of type {numbers.dtype}; whole numbers from 0 to {count}, the number of sources")
    if numbers.shape != size[::-1]:
        raise UsageError(f"owners of shape {numbers.shape}; needed is that of the target, {size[::-1]}")
    return numbers.astype(np.uint16)


def _surface(surface: Any, target: Target) -> Surface:
    """The surface in the target's CRS; a file that the target does not meet is refused."""
    if hasattr(surface, "relief"):
        found: Surface = surface
        return found
    if isinstance(surface, int | float | np.integer | np.floating) and not isinstance(surface, bool):
        if not np.isfinite(surface):
            raise UsageError(f"surface: height {surface}; give a finite number")
        return LevelSurface(float(surface))
    file = file_of(surface)
    if file is None:
        raise UsageError(
            f"surface: {described(surface)}; give the path of a height raster or terrain model, a dataset that is open "
            "from a file, one height, or a surface such as photoplan.RasterSurface"
        )
    crs = target.placement.crs
    terrain = open_terrain(Path(file), default_crs=crs)
    if crs is None or not isinstance(target, MapTarget):
        return (terrain if crs is None else terrain.in_crs(crs)[0]).surface
    own = terrain.crs
    placed = terrain.in_crs(crs)[0]
    try:
        placed.refuse_apart(target.grid.bounds)
    except PhotoplanError as error:
        raise type(error)(f"{error}. The target's CRS is {crs_label(crs)}, the surface's {crs_label(own)}") from None
    return placed.surface
