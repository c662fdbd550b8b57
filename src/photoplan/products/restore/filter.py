"""What a restoration is asked for, and its filter: of a file, for the aperture of a scanner, or measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.io.disk import make_parents
from photoplan.io.filter_file import filter_text
from photoplan.io.storage import COMPRESSIONS
from photoplan.products.restore.design import DesignRequest, MeasuredFilter, design_restoration
from photoplan.project.filter_files import entries_of, load_filter, save_filter
from photoplan.quality.colour.model import ChromaticModel
from photoplan.quality.restoration.aperture import aperture_filter
from photoplan.quality.restoration.filters import FilterKernel, RestorationFilter

#: File that a measured filter is written to, in the folder of the results.
FILTER_NAME = "restoration_filter.toml"
#: Description of the filter that leaves images as they are.
NO_FILTER = "none"


@dataclass(frozen=True)
class FilterRequest:
    """Where a filter comes from: one of these."""

    file: Path | None = None
    aperture: str | None = None
    """``square`` or ``round``, with ``:RATIO`` of aperture by step where that is not 1."""
    design: DesignRequest | None = None
    none: bool = False
    """No filter: the image is corrected otherwise alone."""

    def __post_init__(self) -> None:
        if sum(source is not None for source in (self.file, self.aperture, self.design)) + self.none != 1:
            raise UsageError("give a filter file, the aperture of a scanner, or images to measure; one of them")


@dataclass(frozen=True, eq=False)
class FoundFilter:
    """A filter and where it comes from."""

    filter: RestorationFilter
    origin: str
    """In words: "the file …"; empty: there is no filter."""
    measured: MeasuredFilter | None = None
    """What was measured, where it was."""


def requested_filter(request: FilterRequest, events: Events = SILENT) -> FoundFilter:
    """The filter that is asked for."""
    if request.none:
        return FoundFilter(RestorationFilter((FilterKernel(np.ones((1, 1))),), description=NO_FILTER), "")
    if request.file is not None:
        return FoundFilter(load_filter(request.file), f"the file {request.file}")
    if request.aperture is not None:
        return FoundFilter(_for_aperture(request.aperture), f"the aperture of a scanner, {request.aperture}")
    assert request.design is not None
    found = design_restoration(request.design, events)
    for line in _lines(found):
        events.talk(line)
    return FoundFilter(found.filter, "edges of the images", found)


def keep_filter(path: Path, filter_: RestorationFilter, *, overwrite: bool = False) -> Path:
    """Write a filter beside its results, unless the file holds the very same one already."""
    try:
        if path.read_text(encoding="utf-8") == filter_text(entries_of(filter_)):
            return path
    except (OSError, UnicodeDecodeError):
        pass
    try:
        make_parents(path.parent)
    except OSError as error:
        raise UsageError(f"{path.parent}: cannot be made ({error.strerror})") from None
    return save_filter(path, filter_, overwrite=overwrite)


def _for_aperture(text: str) -> RestorationFilter:
    shape, _, stated = text.partition(":")
    try:
        ratio = float(stated) if stated else 1.0
    except ValueError:
        ratio = float("nan")
    if shape not in ("square", "round") or ratio != ratio:
        raise UsageError(
            f"`aperture` {text}; it is square or round, with :RATIO of aperture by step, such as round:1.2"
        )
    kernel = FilterKernel(aperture_filter(cast(Literal["square", "round"], shape), ratio))
    facts = {"rule": f"inverse of the transfer function of a {shape} aperture of {ratio:g} steps (Ecker 1991, eq. 4.5)"}
    return RestorationFilter((kernel,), description=f"{shape} aperture, {ratio:g} steps", facts=facts)


def _lines(found: MeasuredFilter) -> list[str]:
    """What was measured, for people."""
    lines = []
    for part in found.parts[:9]:
        name = "all bands" if part.band is None else f"band {part.band}"
        where = "" if part.at is None else f" at column {part.at[0]:.0f}, row {part.at[1]:.0f}"
        sides = ["  ".join(f"{v:.3f}" for v in one.spread.side()[:4]) for one in part.sharpness]
        lines.append(
            f"{name}{where}: {part.edges} edges; spread function along rows {sides[0]}, along columns {sides[1]}; "
            f"{part.design.method}, noise grows {part.design.noise_gain:.1f} times"
        )
    if len(found.parts) > 9:
        lines.append(f"… and {len(found.parts) - 9} more parts; the filter file has them all")
    return lines + list(found.notes)


#: What `dtype` may be; grey values keep their scale in all of them.
TYPES = ("same", "float32", "uint16")


@dataclass(frozen=True)
class RestoreRequest:
    """What is asked."""

    images: tuple[Path, ...]
    filter: RestorationFilter | Path
    """The filter, or its file."""
    output: Path | None = None
    """Folder of the results; None: `restored` beside the first image."""
    bands: tuple[int, ...] = ()
    """Bands that are restored, from 1; all if empty. The others stay as they are."""
    linearisation: str = "linear"
    """``linear``, ``srgb`` or a file with a table."""
    dtype: str = "same"
    """Type of the results: ``same``, ``float32`` or ``uint16``."""
    chromatic: ChromaticModel | Path | Literal["measure"] | None = None
    """Lateral chromatic aberration, which is corrected before the filter: a model, its file, or ``measure``: every
    image's own discs or edges; None: the bands stay where they are."""
    fall_off: Path | None = None
    """A correction of light fall-off, which comes before all others."""
    compress: str = "deflate"
    workers: int = 1
    memory: int | None = None
    """Bytes the run should stay under; None: no bound but the tiles in flight."""
    overwrite: bool = False
    quicklook: bool = True

    def __post_init__(self) -> None:
        if not self.images:
            raise UsageError("no image is given")
        if self.dtype not in TYPES:
            raise UsageError(f"dtype {self.dtype!r}; allowed are {', '.join(TYPES)}")
        if self.compress not in COMPRESSIONS:
            raise UsageError(f"compression {self.compress!r}; allowed are {', '.join(COMPRESSIONS)}")

    @property
    def folder(self) -> Path:
        """Where the results are written."""
        return self.images[0].parent / "restored" if self.output is None else self.output

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the results beside images and filter, as plain values."""
        return {
            "bands": list(self.bands),
            "linearisation": self.linearisation,
            "dtype": self.dtype,
            "chromatic": "a model"
            if isinstance(self.chromatic, ChromaticModel)
            else self.chromatic and str(self.chromatic),
            "fall_off": self.fall_off and str(self.fall_off),
            "compress": self.compress,
        }
