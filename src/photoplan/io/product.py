"""A product file that appears under its name only when it is complete."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.crs
import rasterio.transform
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError, PhotoplanError, UsageError
from photoplan.geometry.grid import Placement, Window
from photoplan.io.gdal import GDAL_ERRORS, open_raster
from photoplan.io.image_form import ImageForm, dress
from photoplan.io.kept_tiles import KeptTiles
from photoplan.io.naming import is_unfinished, standing, when_named
from photoplan.io.plain_tiff import write_plain_tiff
from photoplan.io.product_check import check_product
from photoplan.io.run_record import record_path, refuse_foreign_record
from photoplan.io.storage import PRODUCT_TYPES, BlockCoder, CogOptions, Nodata, nodata_for, write_cog, write_picture
from photoplan.io.tile_log import TileLog, log_of
from photoplan.io.unfinished import Unfinished

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
        self._file = Unfinished(
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
        self,
        index: int,
        pixels: ArrayLike,
        valid: NDArray[np.bool_] | None = None,
        record: Mapping[str, Any] | None = None,
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

        def expected(window: Window) -> tuple[NDArray[Any], NDArray[np.bool_]]:
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
