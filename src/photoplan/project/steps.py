"""Steps from pixels to pixels: linearisation, fall-off, balance, restoration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.execute import Step
from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Pixels, Window, reduced
from photoplan.io.disk import Nodata
from photoplan.io.files import fingerprint
from photoplan.io.product import check_output
from photoplan.io.quality_files import (
    FilterEntries,
    KernelEntry,
    filter_text,
    plain_fact,
    read_balance_file,
    read_fall_off_entry,
    read_filter_file,
)
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import RasterInfo
from photoplan.io.store import write_atomically
from photoplan.io.tables import Columns, read_table
from photoplan.plain import pick
from photoplan.quality.camera.fall_off import FallOffModel, correct_fall_off, largest_gain
from photoplan.quality.curves import Linearisation
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter, RestoredPixels, Restorer, light_of
from photoplan.radiometry.tone import Tone, toned


def load_filter(path: Path) -> RestorationFilter:
    """A filter of a file: TOML, or one kernel as rows of numbers."""
    entries = read_filter_file(path)
    try:
        kernels = tuple(FilterKernel(np.array(k.values), k.at, k.band) for k in entries.kernels)
        return RestorationFilter(kernels, entries.image_size, entries.description, entries.facts)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def save_filter(path: Path, filter_: RestorationFilter, *, overwrite: bool = False) -> Path:
    """Write a filter as TOML; reading it gives the same values to the last digit."""
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise UsageError(f"{path}: a filter is written as TOML; give a name that ends in .toml")
    check_output(path, overwrite=overwrite)
    write_atomically(path, filter_text(entries_of(filter_)).encode())
    return path


def entries_of(filter_: RestorationFilter) -> FilterEntries:
    """A filter as its file says it."""
    kernels = tuple(KernelEntry(values=k.values.tolist(), at=k.at, band=k.band) for k in filter_.kernels)
    facts = {str(name): plain_fact(value) for name, value in filter_.facts.items() if value is not None}
    size, words = filter_.image_size, filter_.description
    return FilterEntries(kernels=kernels, image_size=size, description=words, facts=facts)


#: A table of 65536 lines of four long numbers.
_MAX_BYTES = 8_000_000


def linearisation_of(words: str) -> Linearisation:
    """What ``linear``, ``srgb`` or the name of a table stand for."""
    if words in ("linear", "srgb"):
        return Linearisation("linear" if words == "linear" else "srgb")
    path = Path(words)
    if not path.is_file():
        raise InputError(f"linearisation {words}: is no file; give linear, srgb, or a table that exists")
    table = read_linearisation_table(path)
    try:
        return Linearisation.from_table(table)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_linearisation_table(path: Path) -> NDArray[np.float64]:
    """The numbers of a linearisation table.

    Columns are separated by spaces, tabs, semicolons or commas; empty lines, lines that begin with ``#`` and a first
    line of words are passed over. One column holds the light of the grey values 0, 1, 2 …, two hold grey value and
    light, three the light in three bands, four the grey value and the light in three bands.
    """
    order = tuple(f"column {n}" for n in range(1, 5))
    columns = Columns(
        roles={}, needed=order[:1], orders=(order,), numbers=frozenset(order), untitled=True, row="line with numbers"
    )
    table = read_table(path, columns, max_bytes=_MAX_BYTES)
    if table.layout.width > len(order):
        raise InputError(f"{table.where(0)}: {table.layout.width} columns, at most {len(order)} are read")
    return np.stack([table.numbers(role) for role in table.roles], axis=1)


def read_fall_off(path: Path) -> FallOffModel:
    """The model of a correction file; `photoplan.quality.camera.fall_off.correct_fall_off` applies it."""
    entry = read_fall_off_entry(path)
    try:
        return FallOffModel(
            size=entry.size,
            principal_point=entry.principal_point_px,
            camera_constant=entry.camera_constant_px,
            terms=tuple((term.n, term.m) for term in entry.terms),
            coefficients=tuple(term.coefficient for term in entry.terms),
            dark=entry.dark_dn,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


@dataclass(frozen=True)
class FallOffFile:
    """A correction and the file that it comes from."""

    path: Path
    model: FallOffModel
    gain: float
    """The largest in the image: noise grows by it there."""
    digest: str

    def json_fields(self) -> dict[str, Any]:
        """The model by its entries."""
        model = self.model
        return {
            **pick(self, "path", sampled_sha256="digest", largest_gain="gain"),
            **pick(
                model,
                "size",
                principal_point_px="principal_point",
                camera_constant_px="camera_constant",
                dark_dn="dark",
            ),
            "terms": [[n, m, value] for (n, m), value in zip(model.terms, model.coefficients)],
        }


def load_fall_off(path: Path) -> FallOffFile:
    """A correction of a file that `photoplan characterise` wrote."""
    model = read_fall_off(path)
    try:
        return FallOffFile(path, model, largest_gain(model), fingerprint(path).digest)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(str(path)) else f"{path}: {message}") from None


def fall_off_line(used: FallOffFile) -> str:
    """A correction in words."""
    return f"light fall-off corrected by {used.path.name}: gain up to {used.gain:.3g}, noise there grows with it"


@dataclass(frozen=True, eq=False)
class FallOffStep:
    """Grey values to light with the fall-off corrected, the same gain in all bands.

    Grey values are decoded to light and corrected; what comes out is float32 on the scale of the image's type, neither
    rounded nor clipped. The grey value of no light is decoded by the same curve.
    """

    fall_off: FallOffFile
    linearisation: Linearisation
    stored: np.dtype[Any]
    """Type of the image."""

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The correction is for images of one size."""
        known = self.fall_off.model.size
        if size != known:
            raise InputError(
                f"{size[0]} × {size[1]} pixels; the light fall-off in {self.fall_off.path} is for "
                f"images of {known[0]} × {known[1]}: an image that was cropped or scaled needs a correction of its own"
            )

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """Float32, whatever the image has."""
        return np.dtype(np.float32)

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """The window itself."""
        return window

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Light of a window and its validity."""
        light = np.empty(pixels.shape, np.float32)
        dark = np.zeros((pixels.shape[0], 1, 1), np.float32)
        for band, grey in enumerate(pixels, start=1):
            if valid is not None and not valid.any():
                light[band - 1] = 0.0
                continue
            light[band - 1] = light_of(self.linearisation, grey, valid, band)
            dark[band - 1] = self._dark(band)
        corrected, _ = correct_fall_off(light - dark, window, replace(self.fall_off.model, dark=0.0))
        return corrected + dark, valid

    def _dark(self, band: int) -> float:
        """Light of the grey value of no light: that of a fraction of the type's scale, too."""
        dark, curve = self.fall_off.model.dark, self.linearisation
        if curve.is_linear or dark == 0.0:
            return dark
        scale = curve.full_scale(self.stored) if curve.kind == "srgb" else 1.0
        return float(curve.to_linear(np.array([dark / scale]), band)[0]) * scale


@dataclass(frozen=True, eq=False)
class BalanceStep:
    """Table and trend of each band; the type of the pixels stays."""

    path: Path
    size: tuple[int, int]
    tones: tuple[Tone, ...]

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The tables are for an image of one size and number of bands."""
        if size != self.size or bands != len(self.tones):
            raise InputError(
                f"{size[0]} × {size[1]} pixels, {bands} bands; the tables in {self.path} are for {self.size[0]} × "
                f"{self.size[1]} and {len(self.tones)}: run `photoplan balance` again, or remove the image's `balance`"
            )

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """The same."""
        return stored

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """The window itself."""
        return window

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Balanced pixels of a window and their validity."""
        return toned(pixels, window, self.size, self.tones), valid


def load_balance(path: Path) -> BalanceStep:
    """The step of a balance file."""
    entry = read_balance_file(path)
    tones = []
    for number, band in enumerate(entry.bands, 1):
        try:
            tones.append(Tone(band.grey, band.becomes, band.trend, (band.curve_grey, band.curve_light)))
        except InputError as error:
            raise InputError(f"{path}: band {number}: {error}") from None
    return BalanceStep(path, entry.size, tuple(tones))


#: Side of the parts in which a large window goes through steps: what bounds memory. The result does not depend on it.
PART = 512
S = TypeVar("S")


@dataclass(frozen=True, eq=False)
class SteppedReader:
    """An image file behind the engine's `Reader`, its pixels as they are after some steps."""

    image: RasterReader
    steps: tuple[Step, ...] = ()

    def __post_init__(self) -> None:
        for step in self.steps:
            try:
                step.check(self.size, self.bands)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from None

    @property
    def info(self) -> RasterInfo:
        """Facts of the file."""
        return self.image.info

    @property
    def path(self) -> Path:
        """The file."""
        return self.image.path

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.image.size

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.image.bands

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels after the last step."""
        return self.dtype_before(len(self.steps))

    def dtype_before(self, step: int) -> np.dtype[Any]:
        """Type of the pixels that a step gets."""
        stored = self.image.dtype
        for each in self.steps[:step]:
            stored = each.result(stored)
        return stored

    def step(self, kind: type[S]) -> S | None:
        """The step of a kind; None: there is none."""
        return next((step for step in self.steps if isinstance(step, kind)), None)

    def then(self, *steps: Step) -> SteppedReader:
        """The same with further steps."""
        return SteppedReader(self.image, (*self.steps, *steps))

    def read(self, window: Window, level: int = 0) -> Pixels:
        """Pixels of a window and their validity, see `engine.base.Reader`; reduced after the last step."""
        if not self.steps:
            return self.image.read(window, level)
        if level:
            return reduced(self, window, level)
        parts = list(window.tiles(PART))
        if len(parts) == 1:
            return self._after(len(self.steps), window)
        values = np.empty((self.bands, window.height, window.width), self.dtype)
        valid = np.ones((window.height, window.width), bool)
        for part in parts:
            pixels, good = self._after(len(self.steps), part)
            rows, cols = part.slices(window)
            values[:, rows, cols] = pixels
            if good is not None:
                valid[rows, cols] = good
        return values, None if valid.all() else valid

    def before_last(self, window: Window) -> tuple[Window, Pixels]:
        """What the last step is given for a window: pixels around it, and where they are."""
        return self._before(len(self.steps) - 1, window)

    def _before(self, number: int, window: Window) -> tuple[Window, Pixels]:
        at = self.steps[number].around(window, self.size, False)
        pixels = self._after(number, at)
        if pixels[1] is not None:
            wide = self.steps[number].around(window, self.size, True)
            if wide != at:
                at, pixels = wide, self._after(number, wide)
        return at, pixels

    def _after(self, count: int, window: Window) -> Pixels:
        """Pixels after the first `count` steps."""
        if count == 0:
            return self.image.read(window)
        at, (pixels, valid) = self._before(count - 1, window)
        try:
            return self.steps[count - 1].apply(window, at, pixels, valid)
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from None


@dataclass(frozen=True, eq=False)
class RestoreStep:
    """Restoration by a filter: the pixels that `photoplan restore` writes."""

    restorer: Restorer
    lit: bool = False
    """Whether light fall-off was corrected before, so that pixels are light already."""

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The restorer was made for the image."""

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """Type of the restored pixels."""
        return self.restorer.out

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """The filter's margin; more where pixels are missing, since what stands in for them may lie further away."""
        margin = self.restorer.margin
        return margin.around(window, size, gaps=gaps or not margin.fits(window, size))

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Restored pixels of a window and their validity."""
        restored = self.restorer.restore(window, pixels, at, valid)
        return restored.values, restored.valid

    def describe(self) -> str:
        """How the pixels are restored, in words."""
        used = self.restorer.filter
        columns, rows = used.margin
        name = f' "{used.description}"' if used.description else ""
        lit = "light fall-off corrected; " if self.lit else ""
        return (
            f"{lit}restored with the filter{name}, {2 * columns + 1} × {2 * rows + 1}; noise grows "
            f"{used.noise_gain:.3g} times; {self.restorer.linearisation.describe()}"
        )


def read_counted(reader: SteppedReader, window: Window) -> RestoredPixels:
    """Pixels of a window of an image that is restored last, and how many were clipped."""
    at, (pixels, valid) = reader.before_last(window)
    try:
        return restoration_of(reader).restorer.restore(window, pixels, at, valid)
    except InputError as error:
        raise InputError(f"{reader.path}: {error}") from None


def restoration_of(reader: SteppedReader) -> RestoreStep:
    """The last step of an image that is restored."""
    step = reader.steps[-1]
    assert isinstance(step, RestoreStep)
    return step


def kept_nodata(info: RasterInfo, out: np.dtype[Any]) -> Nodata:
    """How a restored copy says which pixels are invalid: by the image's own value where it can, else by a mask.

    Floating point takes NaN, since a restored value may happen to be any number.
    """
    if out.kind == "f":
        return float("nan")
    if info.nodata is None or not np.isfinite(info.nodata) or info.palette:
        return "mask"
    limits = np.iinfo(out)
    whole = info.nodata == int(info.nodata) and limits.min <= info.nodata <= limits.max
    return info.nodata if whole else "mask"


def restored(
    source: SteppedReader,
    filter_: RestorationFilter,
    linearisation: Linearisation | None = None,
    out: np.dtype[Any] | None = None,
) -> SteppedReader:
    """An image restored with a filter."""
    stored = np.dtype(source.info.dtype)
    out = stored if out is None else out
    nodata = kept_nodata(source.info, out)
    avoided = nodata if isinstance(nodata, float) and out.kind != "f" else None
    light, lit = linearisation or Linearisation(), source.step(FallOffStep) is not None
    try:
        restorer = Restorer(
            filter=filter_,
            size=source.size,
            bands=source.bands,
            dtype=stored,
            out=out,
            linearisation=light,
            nodata=avoided,
            light_given=lit,
        )
    except InputError as error:
        raise InputError(f"{source.path}: {error}") from None
    return source.then(RestoreStep(restorer, lit))
