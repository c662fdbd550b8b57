"""Raster products: writing, verification, virtual rasters, overviews, quick looks."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.crs
import rasterio.enums
import rasterio.transform
import rasterio.windows
from numpy.typing import ArrayLike, NDArray

from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError, PhotoplanError, UsageError
from photoplan.geometry.grid import Placement, Window
from photoplan.io.disk import (
    GDAL_ERRORS,
    PRODUCT_TYPES,
    BlockCoder,
    CogOptions,
    Nodata,
    first_cause,
    gdal_settings,
    nodata_for,
    not_georeferenced,
    open_raster,
    write_cog,
    write_picture,
)
from photoplan.io.files import check_plain_file, raster_driver
from photoplan.io.raster_info import ImageForm, TiffArray, dress, read_tiff_layout, read_tiff_layouts
from photoplan.io.store import (
    KeptTiles,
    StagedOutput,
    TileLog,
    is_unfinished,
    log_of,
    record_path,
    refuse_foreign_record,
    standing,
    when_named,
    write_atomically,
)
from photoplan.plain import xml_text

_CHUNK = 8 << 20
_NO_KERNEL_COPY = {errno.EXDEV, errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EPERM}


def write_plain_tiff(
    path: Path,
    profile: dict[str, Any],
    tags: dict[str, str],
    blocks: Iterable[tuple[int, int, int]],
    source: int,
    dress: Callable[[Any], None] | None = None,
) -> None:
    """Write a tiled TIFF."""
    path.unlink(missing_ok=True)
    fixed = {"driver": "GTiff", "tiled": True, "interleave": "pixel", "sparse_ok": True, "compress": "none"}
    colours = profile.get("colormap")
    fixed = {name: value for name, value in (profile | fixed).items() if name != "colormap"}
    with gdal_settings(GDAL_PAM_ENABLED=False), not_georeferenced(), rasterio.open(path, "w", **fixed) as dataset:
        if colours is not None:
            dataset.write_colormap(1, colours)
        if dress is not None:
            dress(dataset)
        dataset.update_tags(**tags)
    layout = read_tiff_layout(path)
    offsets, counts = np.zeros_like(layout.offsets), np.zeros_like(layout.counts)
    descriptor = os.open(path, os.O_RDWR | getattr(os, "O_BINARY", 0))
    try:
        end = -(-os.lseek(descriptor, 0, os.SEEK_END) // 16) * 16
        for block, position, length in blocks:
            _copy(source, position, descriptor, end, length)
            offsets[block], counts[block] = end, length
            end += length
        _fill(descriptor, path, layout.offsets_array, offsets)
        _fill(descriptor, path, layout.counts_array, counts)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _fill(descriptor: int, path: Path, place: TiffArray, values: Any) -> None:
    """Write a block table where GDAL left room for it."""
    dtype = np.dtype(place.dtype)
    if values.max(initial=0) > np.iinfo(dtype).max:
        raise PhotoplanError(
            f"{path}: block positions do not fit into {dtype}; this is a fault of photoplan, report it"
        )
    os.lseek(descriptor, place.position, os.SEEK_SET)
    raw = memoryview(values.astype(dtype).tobytes())
    while raw:
        raw = raw[os.write(descriptor, raw) :]


def _copy(source: int, position: int, target: int, end: int, length: int) -> None:
    """Copy bytes between two files, inside the kernel where it can."""
    while length > 0:
        done = 0
        if sys.platform == "linux":
            try:
                done = os.copy_file_range(source, target, length, position, end)
            except OSError as error:
                if error.errno not in _NO_KERNEL_COPY:
                    raise
        if not done:
            os.lseek(source, position, os.SEEK_SET)
            os.lseek(target, end, os.SEEK_SET)
            done = os.write(target, os.read(source, min(length, _CHUNK)))
        position, end, length = position + done, end + done, length - done


_SIDE = 16
_LOSSY = 16.0
"""Difference in grey values of means over 16 × 16 pixels up to which a tile compressed with losses counts as the one
that was computed: compression changes fine detail and noise, means hardly."""


def check_product(
    path: Path,
    profile: dict[str, Any],
    samples: Sequence[Window],
    expected: Callable[[Window], tuple[NDArray[Any], Mask]],
    *,
    lossy: bool,
    overviews: bool,
    driver: str = "COG",
) -> None:
    """Compare a file with what it must hold."""
    if driver == "COG":
        read_tiff_layouts(path)
    with open_raster(path, "GTiff" if driver == "COG" else driver) as dataset, gdal_settings():
        for name in ("width", "height", "count", "transform"):
            if getattr(dataset, name) != profile[name]:
                raise PhotoplanError(f"{path}: {name} is {getattr(dataset, name)}, not {profile[name]}")
        if dataset.dtypes[0] != profile["dtype"]:
            raise PhotoplanError(f"{path}: pixels are {dataset.dtypes[0]}, not {profile['dtype']}")
        if profile["crs"] is not None and (
            dataset.crs is None or dataset.crs.to_epsg() != rasterio.crs.CRS.from_user_input(profile["crs"]).to_epsg()
        ):
            raise PhotoplanError(f"{path}: the reference system {profile['crs']} was not kept")
        if overviews and not dataset.overviews(1):
            raise PhotoplanError(f"{path}: the overviews are missing")
        for factor in dataset.overviews(1):
            shape = -(-dataset.height // factor), -(-dataset.width // factor)
            if shape[0] * shape[1] <= 1 << 20:
                dataset.read(1, out_shape=shape)
        for window in samples:
            _compare(path, dataset, window, *expected(window), lossy=lossy)


def _compare(path: Path, dataset: Any, window: Window, wanted: NDArray[Any], seen: Mask, *, lossy: bool) -> None:
    """Compare one window of a file with what was computed."""
    area = rasterio.windows.Window(window.col, window.row, window.width, window.height)
    pixels, valid = dataset.read(window=area), (dataset.read_masks(window=area) > 0).any(axis=0)
    good = np.array_equal(valid, seen)
    if good and lossy:
        good = float(np.abs(_block_means(pixels * valid) - _block_means(wanted * valid)).max()) <= _LOSSY
    elif good:
        good = np.array_equal(pixels[:, valid], wanted[:, valid], equal_nan=pixels.dtype.kind == "f")
    if not good:
        raise PhotoplanError(f"{path}: {window} is not what was computed; the disk or a library is at fault, run again")


def _block_means(pixels: NDArray[Any]) -> Floats:
    """Means over blocks of 16 × 16 pixels, shape (bands, rows, columns) of blocks; the last ones are smaller."""
    rows, cols = (np.arange(0, length, _SIDE) for length in pixels.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(pixels.astype(np.float64), rows, axis=1), cols, axis=2)
    heights = np.diff([*rows, pixels.shape[1]])
    widths = np.diff([*cols, pixels.shape[2]])
    return np.asarray(sums / (heights[:, None] * widths))


#: The tag in which a product describes itself, where its place does not.
DESCRIPTION = "PHOTOPLAN_VIEW"
_SAMPLES = 12
_BIG = 3_900_000_000


@dataclass(frozen=True)
class ProductFacts:
    """What became of a product."""

    path: Path
    """The file."""
    bytes: int
    tiles: int
    """Tiles of the product."""
    empty_tiles: int
    """Tiles without a valid pixel; they are not stored."""
    valid_share: float
    """Share of valid pixels, 0 to 1."""
    moved_values: int
    """Valid values that equalled nodata and became its neighbour."""
    kept: str = ""
    """What the run record keeps of its tiles, see `KeptTiles`; empty if nothing is asked for."""


def check_output(
    path: Path, inputs: Sequence[Path | str] = (), *, overwrite: bool = False, raster: bool = False
) -> None:
    """Refuse an output that exists, or that is one of the inputs, also by a link, or a `raster` of another suffix."""
    for source in map(Path, inputs):
        same = path.exists() and source.exists() and path.samefile(source)
        if same or path.resolve() == source.resolve():
            raise UsageError(f"{path}: the output is the input {source}; choose another output")
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; give the name of a file")
    if raster and path.suffix.lower() not in (".tif", ".tiff"):
        raise UsageError(f"{path}: images are written as TIFF; give a name that ends in .tif")
    if overwrite:
        return
    if (path.exists() or path.is_symlink()) and not is_unfinished(path):
        raise UsageError(f"{path}: exists already; choose another output or say `overwrite`")
    refuse_foreign_record(record_path(path))


def is_product(path: Path, tag: str = "PHOTOPLAN_KEY") -> bool:
    """Return whether a file is a raster that `ProductFile` wrote for a product with a key, or another tag."""
    if not path.is_file():
        return False
    try:
        with open_raster(path, "GTiff") as dataset:
            return tag in dataset.tags()
    except InputError:
        return False


@dataclass(eq=False)
class ProductFile:
    """Collects finished tiles and makes a cloud-optimised GeoTIFF of them; a context manager.

    Tiles go into a crash-safe log beside the output, so that the next run with the same `run_key` finds them in
    `finished`. `complete` assembles the product under a temporary name, opens it again, compares it with the log,
    and only then gives it its name. Leaving the context without `complete` keeps the log.

    A second run on the same output is refused while the first one lives. `append` may be called from several threads.
    """

    path: Path
    """The product."""
    placement: Placement
    """Its size, and where its pixels are."""
    bands: int
    """Bands."""
    dtype: np.dtype[Any]
    """uint8, uint16, int16, float32 or float64."""
    _: KW_ONLY
    run_key: str
    """A digest of inputs, parameters and version: another key starts afresh."""
    nodata: Nodata = "auto"
    """A value, `mask` for a mask band, or `auto`: 0 for unsigned integers, -32768 for int16, NaN for float32. JPEG
    always takes a mask."""
    compress: str = "deflate"
    """`none`, `deflate`, `zstd`, `lzw` or `jpeg`."""
    overviews: bool = True
    """Reduced copies inside the file."""
    tile: int = 512
    """Side of tiles and blocks, pixels; a multiple of 16, at least 128."""
    overwrite: bool = False
    """Replace an output that exists."""
    inputs: Sequence[Path | str] = ()
    """Files that must not be overwritten."""
    quality: int = 90
    """Quality of JPEG."""
    threads: int = 1
    """Threads that compress."""
    resampling: str = "average"
    """How the overviews are made: `average`, `mode` or `nearest`."""
    colours: Mapping[int, tuple[int, int, int]] | None = None
    """Colour table of one band of uint8."""
    driver: str = "COG"
    """Format of the file: COG, or a picture without a place, PNG or JPEG, of one or three bands of uint8 that are all
    valid; its description is the tag PHOTOPLAN_VIEW."""
    form: ImageForm | None = None
    """Of an image whose copy the product is: its names and colours of bands and its metadata are taken over."""
    tiles: KeptTiles | None = None
    """What decides each tile: those of the file that is replaced are taken over where it is the same."""

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        self.dtype = np.dtype(self.dtype)
        if self.dtype.name not in PRODUCT_TYPES:
            raise UsageError(f"{self.path}: pixels of type {self.dtype}; allowed are {', '.join(PRODUCT_TYPES)}")
        if self.bands < 1 or (self.compress == "jpeg" and (self.dtype != np.uint8 or self.bands not in (1, 3))):
            raise UsageError(
                f"{self.path}: {self.bands} bands of {self.dtype} with compression {self.compress}; JPEG takes one or "
                "three bands of uint8, the others one band and more"
            )
        if self.driver != "COG" and (self.dtype != np.uint8 or self.bands not in (1, 3) or self.placement.transform):
            raise UsageError(f"{self.path}: {self.bands} bands of {self.dtype}; a picture has one or three of uint8")
        self._options = CogOptions(
            self.compress,
            self.overviews,
            self.tile,
            quality=self.quality,
            threads=self.threads,
            resampling=self.resampling,
        )
        value = nodata_for(self.dtype, self.nodata, self.compress)
        self._coder = BlockCoder(self.tile, self.bands, self.dtype, value, lossy=self.compress == "jpeg")
        self._windows = tuple(self.placement.window.tiles(self.tile))
        self._file = StagedOutput(
            path=self.path,
            log_path=self.log_path,
            what="tiles",
            check=lambda: check_output(self.path, self.inputs, overwrite=self.overwrite),
            faults=GDAL_ERRORS,
        )

    def __enter__(self) -> ProductFile:
        def begin(log: TileLog) -> None:
            if self.tiles is not None and self.path.is_file():
                self.tiles.take_over(self.path, self._windows, self._coder, log)

        self._file.enter(f"{self.run_key} {self.placement} {self._coder}", begin)
        return self

    def __exit__(self, *error: object) -> None:
        self._file.leave()

    @property
    def windows(self) -> tuple[Window, ...]:
        """The tiles, row by row; a tile's index is its place here."""
        return self._windows

    @property
    def log_path(self) -> Path:
        """Where finished tiles are kept."""
        return log_of(self.path)

    @property
    def finished(self) -> frozenset[int]:
        """Indices of the tiles that need not be computed any more."""
        return self._file.log.finished

    @property
    def nodata_value(self) -> float | None:
        """The nodata value that is stored; None if there is a mask band."""
        return self._coder.nodata

    def record(self, index: int) -> dict[str, Any]:
        """The figures that were kept with a finished tile."""
        return self._file.log.figures(index)

    def append(
        self, index: int, pixels: ArrayLike, valid: Mask | None = None, record: Mapping[str, Any] | None = None
    ) -> None:
        """Add a finished tile."""
        pixels = np.asarray(pixels)
        window = self._windows[index]
        shape = self.bands, window.height, window.width
        if pixels.shape != shape or pixels.dtype != self.dtype:
            raise UsageError(
                f"{self.path}: tile {index} of shape {pixels.shape} and type {pixels.dtype}; needed are {shape} and "
                f"{self.dtype}"
            )
        count = window.size if valid is None else int(np.count_nonzero(valid))
        if count == 0:
            self.append_empty(index, record)
            return
        payload, moved = self._coder.encode(pixels, None if count == window.size else valid)
        self._file.log.append(index, payload, (moved, count), record)

    def append_empty(self, index: int, record: Mapping[str, Any] | None = None) -> None:
        """Add a tile without any valid pixel."""
        if not 0 <= index < len(self._windows):
            raise UsageError(f"{self.path}: tile {index}; the product has tiles 0 to {len(self._windows) - 1}")
        self._file.log.append(index, figures=record)

    def complete(self, tags: dict[str, str] | None = None) -> ProductFacts:
        """Make the product, with these tags, and give it its name; all tiles must have been delivered."""
        log = self._file.log
        missing = sorted(set(range(len(self._windows))) - log.finished)
        if missing:
            raise PhotoplanError(f"{self.path}: {len(missing)} tiles are missing, the first is {missing[0]}")
        self._file.give(lambda folder: self._checked(log, self._assemble(log, tags or {}, folder)))
        facts = self._facts(log)
        when_named(log.remove)
        return facts

    def _profile(self) -> dict[str, Any]:
        """What GDAL is told about the product."""
        blocks = len(self._windows) * (self._coder.pixel_bytes + self._coder.mask_bytes)
        stated = self.placement.crs
        try:
            crs = rasterio.crs.CRS.from_user_input(stated) if stated else None
        except GDAL_ERRORS as error:
            raise UsageError(f"{self.path}: the reference system {stated!r} is not understood ({error})") from error
        photometric = "RGB" if self.bands in (3, 4) and self.dtype.kind != "f" else "MINISBLACK"
        if self.form is not None:
            photometric = self.form.photometric or photometric
        return {
            "width": self.placement.size[0],
            "height": self.placement.size[1],
            "count": self.bands,
            "dtype": self.dtype.name,
            "crs": crs,
            "transform": rasterio.transform.Affine(*self.placement.coefficients),
            "nodata": self._coder.nodata,
            "blockxsize": self.tile,
            "blockysize": self.tile,
            "bigtiff": "YES" if blocks > _BIG else "NO",
            "photometric": photometric,
        } | ({"alpha": "NO"} if self.bands != 3 else {})

    def _assemble(self, log: TileLog, tags: dict[str, str], folder: Path) -> Path:
        """Make the product in a working folder."""
        profile, plain, part = self._profile(), folder / "plain.tif", folder / "part.tif"
        places = [(i, *log.place(i)) for i in sorted(log.finished)]
        stored = [place for place in places if place[2] > 0]
        pixels = self._coder.pixel_bytes
        direct = self.compress == "none" and not self.overviews and not self._coder.mask_bytes
        blocks = ((i, position, pixels) for i, position, _ in stored)
        colours: dict[str, Any] = {}
        if self.colours:
            colours = {"colormap": dict(self.colours), "photometric": "PALETTE"}
        form = self.form
        dresser = None if form is None else lambda dataset: dress(dataset, form)
        write_plain_tiff(part if direct else plain, profile | colours, tags, blocks, log.descriptor, dresser)
        if direct:
            return part
        if self._coder.mask_bytes and self.driver == "COG":
            mask = {"count": 1, "dtype": "uint8", "nodata": None, "photometric": "MINISBLACK"}
            blocks = ((i, position + pixels, self._coder.mask_bytes) for i, position, _ in stored)
            msk = plain.with_name(plain.name + ".msk")
            # Flag 2: the mask holds for all bands.
            flags = {f"INTERNAL_MASK_FLAGS_{band + 1}": "2" for band in range(self.bands)}
            write_plain_tiff(msk, profile | mask, flags, blocks, log.descriptor)
        if self.driver != "COG":
            write_picture(plain, part, self.driver, self.quality, tags.get(DESCRIPTION, ""))
        else:
            write_cog(plain, part, self._options, self.dtype)
        return part

    def _checked(self, log: TileLog, part: Path) -> Path:
        """The assembled file, compared with the log at some tiles."""
        stored = [i for i in sorted(log.finished) if log.place(i)[1] > 0]
        step = max(1, -(-len(stored) // _SAMPLES))
        samples = {self._windows[i]: i for i in stored[::step]}

        def expected(window: Window) -> tuple[NDArray[Any], Mask]:
            return self._coder.decode(log.read(samples[window]), (window.height, window.width))

        check_product(
            part,
            self._profile(),
            list(samples),
            expected,
            lossy="JPEG" in (self.compress.upper(), self.driver),
            overviews=self.overviews and self.driver == "COG" and max(self.placement.size) > self.tile,
            driver=self.driver,
        )
        return part

    def _facts(self, log: TileLog) -> ProductFacts:
        notes = [log.notes(i) for i in log.finished]
        return ProductFacts(
            path=self.path,
            bytes=standing(self.path).stat().st_size,
            tiles=len(self._windows),
            empty_tiles=sum(log.place(i)[1] == 0 for i in log.finished),
            valid_share=sum(count for _, count in notes) / self.placement.window.size,
            moved_values=sum(moved for moved, _ in notes),
            kept="" if self.tiles is None else self.tiles.told(log),
        )


_MARK = "<!-- written by photoplan -->"
#: Pixels that lie over each other do so to this part of their side.
_ALIGNED = 1e-3
_TYPES = {"uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
          "float32": "Float32", "float64": "Float64"}  # fmt: skip


def refuse_foreign_virtual(path: Path) -> None:
    """Refuse to replace a file that `write_virtual` has not written."""
    if path.is_file() and _MARK not in path.read_bytes()[:4096].decode(errors="replace"):
        raise UsageError(f"{path}: exists and is not of photoplan; move it away, or give another name")


def write_virtual(path: Path, rasters: Sequence[Path]) -> None:
    """Write a VRT (GDAL's virtual raster) of rasters of one grid, bands and type, which lie in its folder; replaces an
    older one."""
    left, top, right, bottom = float("inf"), float("-inf"), float("-inf"), float("inf")
    facts = []
    for raster in rasters:
        with rasterio.open(raster) as file:
            b, resolution, crs, dtype = file.bounds, file.res[0], file.crs, file.dtypes[0]
            masked = rasterio.enums.MaskFlags.per_dataset in file.mask_flag_enums[0]
            facts.append((raster.name, b.left, b.top, file.width, file.height))
            count, nodata, colours = file.count, file.nodata, [each.name.capitalize() for each in file.colorinterp]
        left, top, right, bottom = min(left, b.left), max(top, b.top), max(right, b.right), min(bottom, b.bottom)
    size = round((right - left) / resolution), round((top - bottom) / resolution)

    def sources(band: str) -> str:
        found, none = [], 0 if band.startswith("mask") else nodata
        for name, x, y, width, height in facts:
            to = f'xOff="{round((x - left) / resolution)}" yOff="{round((top - y) / resolution)}"'
            at = f'xSize="{width}" ySize="{height}"'
            found.append(
                f'<ComplexSource><SourceFilename relativeToVRT="1">{xml_text(name)}</SourceFilename><SourceBand>{band}'
                f'</SourceBand><SrcRect xOff="0" yOff="0" {at}/><DstRect {to} {at}/>'
                # Where sheets of any outline lie over each other, what one does not show is the other's.
                + ("" if none is None else f"<NODATA>{none!r}</NODATA>")
                + ("<UseMaskBand>true</UseMaskBand>" if masked and not band.startswith("mask") else "")
                + "</ComplexSource>"
            )
        return "\n".join(found)

    none = "" if nodata is None else f"<NoDataValue>{nodata!r}</NoDataValue>"
    bands = [
        f'<VRTRasterBand dataType="{_TYPES[dtype]}" band="{k + 1}">{none}<ColorInterp>{colours[k]}</ColorInterp>\n'
        f"{sources(str(k + 1))}\n</VRTRasterBand>"
        for k in range(count)
    ]
    if masked:
        bands.append(f'<MaskBand><VRTRasterBand dataType="Byte">\n{sources("mask,1")}\n</VRTRasterBand></MaskBand>')
    head = (
        f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">{_MARK}\n<SRS>{xml_text(crs.to_wkt())}</SRS>\n'
        f"<GeoTransform>{left!r}, {resolution!r}, 0, {top!r}, 0, {-resolution!r}</GeoTransform>\n"
    )
    write_atomically(path, (head + "\n".join(bands) + "\n</VRTDataset>\n").encode())


def write_stacked(path: Path, rasters: Mapping[str, Path]) -> None:
    """Write a VRT that shows rasters of one resolution, which lie in its folder, as bands of one, over all of them.

    Each band has the name of its raster, with the number of the band where that has several.
    """
    left, top, right, bottom = float("inf"), float("-inf"), float("-inf"), float("inf")
    opened = {}
    for name, raster in rasters.items():
        with rasterio.open(raster) as file:
            b, resolution, crs = file.bounds, file.res[0], file.crs
            opened[name] = raster.name, b, (file.width, file.height), file.dtypes, file.nodata
        left, top, right, bottom = min(left, b.left), max(top, b.top), max(right, b.right), min(bottom, b.bottom)
    bands: list[str] = []
    for name, (file_name, b, (width, height), dtypes, nodata) in opened.items():
        x, y = (b.left - left) / resolution, (top - b.top) / resolution
        if max(abs(x - round(x)), abs(y - round(y))) > _ALIGNED:
            raise UsageError(f"{file_name}: its pixels do not lie over those of the other orthophotos")
        at = f'xSize="{width}" ySize="{height}"'
        none = "" if nodata is None else f"<NoDataValue>{nodata!r}</NoDataValue>"
        for k, dtype in enumerate(dtypes, 1):
            title = name if len(dtypes) == 1 else f"{name} {k}"
            bands.append(
                f'<VRTRasterBand dataType="{_TYPES[dtype]}" band="{len(bands) + 1}"><Description>{xml_text(title)}'
                f'</Description>{none}<ComplexSource><SourceFilename relativeToVRT="1">{xml_text(file_name)}'
                f'</SourceFilename><SourceBand>{k}</SourceBand><SrcRect xOff="0" yOff="0" {at}/><DstRect '
                f'xOff="{round(x)}" yOff="{round(y)}" {at}/>'
                + ("<UseMaskBand>true</UseMaskBand>" if nodata is None else f"<NODATA>{nodata!r}</NODATA>")
                + "</ComplexSource></VRTRasterBand>"
            )
    size = round((right - left) / resolution), round((top - bottom) / resolution)
    head = (
        f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">{_MARK}\n<SRS>{xml_text(crs.to_wkt())}</SRS>\n'
        f"<GeoTransform>{left!r}, {resolution!r}, 0, {top!r}, 0, {-resolution!r}</GeoTransform>\n"
    )
    write_atomically(path, (head + "\n".join(bands) + "\n</VRTDataset>\n").encode())


_PERCENT = 2.0, 98.0
_SOFTWARE = "photoplan"


def write_quicklook(product: Path, picture: Path, *, max_side: int = 1600) -> Path:
    """Write a PNG of one product; transparent where it has no valid pixel.

    Only the overview of a suitable size is read. Bytes are shown as they are, with their colour table if there is one;
    other types are stretched from the second to the ninety-eighth percentile. One or two bands are shown grey, more as
    red, green, blue.
    """
    _check_side(max_side)
    with _opened(product) as dataset, gdal_settings():
        factor = max(1.0, max(dataset.width, dataset.height) / max_side)
        rgba = _look(product, dataset, _scaled(dataset.width, factor), _scaled(dataset.height, factor))
    return write_png(picture, rgba)


def read_reduced(product: Path, *, max_side: int) -> tuple[NDArray[Any], tuple[float, float, float, float]]:
    """All bands of a product from its nearest overview, NaN where invalid, and its outer edges xmin ymin xmax ymax.

    The product may still wait for its name.
    """
    _check_side(max_side)
    with _opened(standing(product)) as dataset, gdal_settings():
        factor = max(1.0, max(dataset.width, dataset.height) / max_side)
        shape = (_scaled(dataset.height, factor), _scaled(dataset.width, factor))
        try:
            pixels = dataset.read(out_shape=shape, resampling=rasterio.enums.Resampling.nearest, masked=True)
        except (*GDAL_ERRORS, OSError) as error:
            raise InputError(f"{product}: cannot be read ({first_cause(error)})") from error
        edges = dataset.bounds
    return pixels.astype(float).filled(np.nan), (edges.left, edges.bottom, edges.right, edges.top)


def write_overview(products: Sequence[Path], picture: Path, title: str = "", *, max_side: int = 1600) -> Path | None:
    """Write a PNG of many products placed on the map together; the first ones lie on top.

    Transparent where there is nothing. The products must share one reference system;
    those with another one than the first are left out. None if there is nothing to show.
    """
    _check_side(max_side)
    sheets = _placed(products)
    if not sheets:
        return None
    left, top = min(s.left for s in sheets), max(s.top for s in sheets)
    right, bottom = max(s.right for s in sheets), min(s.bottom for s in sheets)
    # Never finer than the finest product: small ones make a small picture.
    pixel = max(max(right - left, top - bottom) / max_side, min(s.pixel for s in sheets))
    canvas = np.zeros((4, _scaled(top - bottom, pixel), _scaled(right - left, pixel)), np.uint8)
    for sheet in reversed(sheets):
        col, row = int((sheet.left - left) / pixel), int((top - sheet.top) / pixel)
        width = min(_scaled(sheet.right - sheet.left, pixel), canvas.shape[2] - col)
        height = min(_scaled(sheet.top - sheet.bottom, pixel), canvas.shape[1] - row)
        with _opened(sheet.path) as dataset, gdal_settings():
            rgba = _look(sheet.path, dataset, width, height)
        part = canvas[:, row : row + height, col : col + width]
        np.copyto(part, rgba, where=rgba[3] > 0)
    return write_png(picture, canvas, title)


def refuse_foreign_overview(picture: Path, title: str = "") -> None:
    """Refuse to replace a picture that `write_overview` did not write, or wrote with another title."""
    if not picture.exists():
        return
    try:
        with open_raster(picture, "PNG") as dataset:
            tags = dataset.tags()
        own = tags.get("Software") == _SOFTWARE and tags.get("Title", "") == title
    except InputError:
        own = False
    if not own:
        raise UsageError(
            f"{picture}: this name is needed for the preview, and the file is not a preview of this command; "
            "move it away, or set `overwrite`"
        )


@dataclass(frozen=True)
class _Sheet:
    """Where a product lies on the map."""

    path: Path
    left: float
    top: float
    right: float
    bottom: float
    pixel: float


def _placed(products: Sequence[Path]) -> list[_Sheet]:
    """Products of the first one's reference system, with their edges on the map."""
    sheets: list[_Sheet] = []
    first: Any = None
    for path in products:
        with _opened(path) as dataset:
            first = dataset.crs if not sheets else first
            north_up = dataset.transform.b == dataset.transform.d == 0 and dataset.transform.e < 0
            if dataset.crs == first and north_up:
                b = dataset.bounds
                sheets.append(
                    _Sheet(
                        path=Path(path),
                        left=b.left,
                        top=b.top,
                        right=b.right,
                        bottom=b.bottom,
                        pixel=dataset.transform.a,
                    )
                )
    return sheets


def _look(path: Path, dataset: Any, width: int, height: int) -> NDArray[np.uint8]:
    """Red, green, blue and alpha, shape (4, height, width), from the nearest overview."""
    indexes = [1, 2, 3] if dataset.count >= 3 else [1, 1, 1]
    # Nearest neighbour in a suitable overview: it is an average already.
    how = {"out_shape": (height, width), "resampling": rasterio.enums.Resampling.nearest}
    try:
        pixels = dataset.read(sorted(set(indexes)), **how)
        valid = (dataset.read_masks(sorted(set(indexes)), **how) > 0).any(axis=0)
    except (*GDAL_ERRORS, OSError) as error:
        raise InputError(f"{path}: cannot be read for a quick look ({first_cause(error)})") from error
    if pixels.dtype != np.uint8:
        pixels = _stretched(pixels, valid)
    elif dataset.count == 1 and dataset.colorinterp[0] == rasterio.enums.ColorInterp.palette:
        table = np.zeros((256, 3), np.uint8)
        for value, colour in dataset.colormap(1).items():
            table[value] = colour[:3]
        pixels = np.moveaxis(table[pixels[0]], -1, 0)
    alpha = valid * np.uint8(255)
    return np.concatenate([np.broadcast_to(pixels, (3, height, width)) * valid, alpha[None]]).astype(np.uint8)


def _stretched(pixels: NDArray[Any], valid: Mask) -> NDArray[np.uint8]:
    """Values from the second to the ninety-eighth percentile of all bands, as bytes."""
    values = pixels[:, valid].astype(np.float64)
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, _PERCENT) if values.size else (0.0, 1.0)
    scaled = (np.nan_to_num(pixels.astype(np.float64), nan=low) - low) * (255.0 / max(high - low, 1e-12))
    return np.clip(scaled, 0, 255).astype(np.uint8)


def write_png(picture: Path, rgba: NDArray[np.uint8], title: str = "") -> Path:
    """Write red, green, blue and alpha, shape (4, height, width): encoded in memory, put in place at once."""
    with not_georeferenced(), gdal_settings(GDAL_PAM_ENABLED=False), rasterio.MemoryFile() as memory:
        profile = {"driver": "PNG", "width": rgba.shape[2], "height": rgba.shape[1], "count": 4, "dtype": "uint8"}
        profile["WRITE_METADATA_AS_TEXT"] = "YES"
        with memory.open(**profile) as dataset:
            dataset.write(rgba)
            dataset.update_tags(Software=_SOFTWARE, **({"Title": title} if title else {}))
        content = memory.read()
    write_atomically(Path(picture), content)
    return Path(picture)


def _opened(path: Path | str) -> Any:
    plain = check_plain_file(os.fspath(path))
    return open_raster(plain, raster_driver(plain))


def _scaled(length: float, factor: float) -> int:
    return max(1, round(length / factor))


def _check_side(max_side: int) -> None:
    if not 16 <= max_side <= 20_000:
        raise UsageError(f"a picture of {max_side} pixels; the longest side must be 16 to 20,000")
