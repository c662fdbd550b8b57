"""Entries of a series file, as checked and frozen values; `photoplan.io.series.file` finds the files that they name."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, Strict, field_validator, model_validator

from photoplan.io.camera.model import Entry, Name, Number, Positive

#: Kinds of frames and what they show.
KINDS = {
    "dark": "no light reaches the sensor",
    "flat": "an evenly lit surface without structure",
    "wedge": "a grey wedge: patches of known density",
    "scene": "any fixed scene, exposed differently from frame to frame",
    "target": "a target taken again and again while the camera warms up",
    "drift": "an evenly lit surface taken again and again over time",
    "step": "frames that follow a sudden change of brightness",
    "plumb": "a straight vertical edge, or two parallel ones",
    "stage": "a target shifted by known steps of a stage",
}
#: Conditions that an entry may state for its frames, and their units.
CONDITIONS = {
    "exposure_ms": "ms",
    "temperature_c": "°C",
    "wavelength_nm": "nm",
    "photons_per_pixel": "photons",
    "irradiance_uw_cm2": "µW/cm²",
    "illumination": "",
    "density": "",
    "time_s": "s",
}

NotNegative = Annotated[float, Strict(), Field(ge=0, le=1e15, allow_inf_nan=False)]
Count = Annotated[int, Strict(), Field(ge=0, le=10_000_000)]
Side = Annotated[int, Strict(), Field(gt=0, le=10_000_000)]
Roi = tuple[Count, Count, Side, Side]


def _not_absurd(pattern: str) -> str:
    # More would make the comparison with a hostile name take for ever.
    if len(pattern) > 1000 or pattern.count("*") > 4 or pattern.count("{") > 8:
        raise ValueError(f"pattern of {len(pattern)} characters; at most 1000 with 4 stars and 8 fields are read")
    return pattern


Pattern = Annotated[str, Field(min_length=1), AfterValidator(_not_absurd)]


class CameraFacts(Entry):
    """What is known of the camera before it is measured; all of it may be left out."""

    name: Name | None = None
    bits: Annotated[int, Strict(), Field(ge=1, le=32)] | None = None
    """Bits of a grey value, so that 2^bits − 1 is the largest; default: those of the files' type."""
    saturation_dn: Positive | None = None
    """Largest grey value that the camera writes, where it is less."""
    black_level_dn: NotNegative = 0.0
    """Grey value that the camera adds to every pixel, for linearity where dark frames are missing."""
    bayer: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    """Colours of the first four pixels of the sensor (two rows of two); None: no colour filters, or bands."""
    pixel_size_um: Positive | None = None
    gain_db: Number | None = None
    """Setting of the camera's amplifier; only printed."""
    focal_px: Positive | None = None
    """Camera constant in pixels, for the cos⁴ part of light fall-off."""
    principal_point_px: tuple[Number, Number] | None = None
    """Column and row where the axis of the lens meets the sensor; default the middle of the image."""
    interlaced: Annotated[bool, Strict()] = False
    """Whether even and odd rows were taken one after the other, as video cameras do."""
    line_frequency_hz: Positive | None = None
    """Rows per second, so that periods along rows become frequencies."""


class StepEntry(Entry):
    """One patch of a grey wedge."""

    density: NotNegative
    roi: Roi
    """Column and row of its first pixel, width and height."""


class EdgeEntry(Entry):
    """One straight edge in plumb frames."""

    name: Name
    roi: Roi
    """Window that the edge crosses from end to end: column and row of its first pixel, width and height."""
    direction: Literal["vertical", "horizontal"] = "vertical"
    """How it runs; a horizontal edge is free of jitter of the rows and shows the method's own noise."""


class TargetEntry(Entry):
    """One round target in target or stage frames."""

    name: Name
    roi: Roi | None = None
    """Window in which it lies in all frames; None: the roi of the frames."""
    bright: Annotated[bool, Strict()] = True
    """Whether it is brighter than its surroundings."""


class FramesEntry(Entry):
    """A group of image files of one kind."""

    files: Pattern | tuple[Pattern, ...]
    """Patterns of files, relative to the series file: ``*``, ``?`` and named fields such as ``{exposure_ms}``."""
    kind: str
    exposure_ms: NotNegative | None = None
    temperature_c: Number | None = None
    wavelength_nm: Positive | None = None
    photons_per_pixel: NotNegative | None = None
    """Mean number of photons that fall on a pixel during the exposure."""
    irradiance_uw_cm2: NotNegative | None = None
    """With wavelength, exposure and the pixel's size: photons per pixel."""
    illumination: Number | None = None
    """Number of a lamp's setting."""
    density: NotNegative | None = None
    """Optical density of what the frames show."""
    time_s: Number | str | None = None
    """Time of the frames: seconds, or an ISO date (``2019-02-08T17:11:46``)."""
    time_from: Literal["exif"] | None = None
    """Take the time of each frame from its EXIF entries."""
    table: str | None = None
    """CSV file with a column ``file`` and columns named as the conditions."""
    roi: Roi | None = None
    """Column and row of the first pixel that counts, width and height."""
    mask: str | None = None
    """Image of the frames' size; pixels that are not zero count."""
    brightest: Annotated[float, Strict(), Field(gt=0, le=1)] | None = None
    """Share of the pixels that counts: those of each plane above this quantile of a reference frame."""
    brightest_exposure_ms: Positive | None = None
    """Exposure of the reference frame; default the longest in which under 0.1 % of the pixels are saturated."""
    steps: tuple[StepEntry, ...] = ()
    """Patches of a grey wedge."""
    edges: Annotated[tuple[EdgeEntry, ...], Field(max_length=200)] = ()
    """Straight edges in plumb frames."""
    targets: Annotated[tuple[TargetEntry, ...], Field(max_length=200)] = ()
    """Round targets in target or stage frames; None named: one in the roi."""
    name: Name | None = None
    values: dict[Name, Number | str] = Field(default_factory=dict)
    """Anything else that an analysis asks for."""

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in KINDS:
            raise ValueError(f"kind {kind!r}; allowed are {', '.join(KINDS)}")
        return kind

    @field_validator("files")
    @classmethod
    def _some(cls, files: Any) -> tuple[str, ...]:
        listed = (files,) if isinstance(files, str) else tuple(files)
        if not listed:
            raise ValueError("no file given")
        return listed

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.time_from is not None and self.time_s is not None:
            raise ValueError("give either time_s or time_from")
        if self.brightest_exposure_ms is not None and self.brightest is None:
            raise ValueError("brightest_exposure_ms needs brightest")
        if self.steps and self.kind != "wedge":
            raise ValueError(f"steps belong to kind wedge; this entry is {self.kind}")
        if self.edges and self.kind != "plumb":
            raise ValueError(f"edges belong to kind plumb; this entry is {self.kind}")
        if self.targets and self.kind not in ("target", "stage"):
            raise ValueError(f"targets belong to kinds target and stage; this entry is {self.kind}")
        for what, listed in (("edges", self.edges), ("targets", self.targets)):
            if len({each.name for each in listed}) < len(listed):
                raise ValueError(f"two {what} have the same name")
        if self.mask is not None and (self.kind in ("plumb", "target", "stage") or self.steps):
            raise ValueError(f"a mask does not count for {'steps' if self.steps else f'kind {self.kind}'}; give rois")
        if self.brightest is not None and (self.kind in ("plumb", "target", "stage", "drift", "step") or self.steps):
            raise ValueError(f"brightest does not count for {'steps' if self.steps else f'kind {self.kind}'}")
        if self.steps and self.density is not None:
            raise ValueError("give either density (one patch fills the frame) or steps")
        return self


class StatisticsEntry(Entry):
    """Figures that were reduced from images before."""

    file: Annotated[str, Field(min_length=1, max_length=1000)]
    format: Literal["csv", "emva1288"] = "csv"
    """``csv``: kind, exposure_ms, photons_per_pixel, mean, variance, pixels, frames; ``emva1288``: the dictionary of
    sums and pseudo-variances of that package's descriptor files."""
    pixels: Side | None = None
    """Pixels of an image, where the file does not say it."""
    frames: Annotated[int, Strict(), Field(ge=2, le=100_000)] = 2
    """Frames of each setting."""
    wavelength_nm: Positive | None = None
    temperature_c: Number | None = None


class PositionsEntry(Entry):
    """Positions of targets that were measured before, as a table."""

    file: Annotated[str, Field(min_length=1, max_length=1000)]
    """CSV with columns x and y (pixels); kind stage also stage_x, stage_y, name; kind target also time_s, target."""
    kind: Literal["stage", "target"]
    unit: Annotated[str, Field(min_length=1, max_length=20)] = "um"
    """Of the stage's coordinates."""
    name: Name | None = None


class SeriesEntry(Entry):
    """The whole file."""

    camera: CameraFacts = CameraFacts()
    frames: tuple[FramesEntry, ...] = ()
    statistics: tuple[StatisticsEntry, ...] = ()
    positions: tuple[PositionsEntry, ...] = ()

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.frames and not self.statistics and not self.positions:
            raise ValueError("holds no [[frames]], [[statistics]] or [[positions]] table")
        return self
