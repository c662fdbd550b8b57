"""What a user may choose about orthophotos."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from photoplan.errors import UsageError
from photoplan.geometry.grid import check_resolution
from photoplan.plan.choice import Weights

Kernel = Literal["nearest", "bilinear", "bicubic", "bicubic-1", "lanczos3"]
Hidden = Literal["show", "nodata", "mark"]
Method = Literal["indirect", "direct"]
Blending = Literal["mean", "multiband"]
Compression = Literal["deflate", "zstd", "lzw", "jpeg", "none"]


#: Gaps wider than twice this, and hidden holes wider than this, are not filled, pixels.
MOST_FILLED = 32


@dataclass(frozen=True)
class Choice:
    """How a mosaic chooses among its images; checked at birth."""

    name: str = "mosaic"
    """Of the product, and of its file without the extension."""
    weights: Weights = field(default_factory=Weights)
    """What each penalty of the score counts."""
    prefer: tuple[str, ...] = ()
    """Images that come before all others wherever they see the ground, the first of them before the next."""
    seams: str | None = None
    """A GeoPackage of regions, each with its image, that come before the score; relative to the project's folder."""

    feather: float = 0.0
    """Width in which images pass into each other along seams, metres; 0: they do not."""

    blend: Blending = "mean"
    """``mean``: all detail passes over that width; ``multiband``: fine detail at the seam, coarse over the width."""

    sheets: float | str | None = None
    """Side of the squares that a mosaic is cut into, metres, or a file of polygons with names, relative to the
    project's folder; None: it is one file."""

    def __post_init__(self) -> None:
        if self.blend not in get_args(Blending):
            raise UsageError(f"`blend` {self.blend!r}; allowed are {', '.join(get_args(Blending))}")
        if self.blend == "multiband" and self.feather == 0:
            raise UsageError("`blend` multiband needs the width over which coarse detail passes; give `feather`")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Choice:
        """A choice from plain values."""
        weights = Weights(**values.get("weights", {}))
        return cls(**{**values, "weights": weights, "prefer": tuple(values.get("prefer", ()))})


@dataclass(frozen=True)
class OrthoSettings:
    """Choices that change the pixels or the file of an orthophoto; checked at birth."""

    resolution: float | None = None
    """Side of a ground pixel, metres; None: the mean ground sampling distance of the images, to two figures."""
    bounds: tuple[float, float, float, float] | None = None
    """Outer edges xmin ymin xmax ymax in the project's CRS; None: all that the image sees of the terrain."""
    kernel: Kernel = "bicubic"
    """Resampling kernel; bicubic is a = −0.5, bicubic-1 is a = −1."""
    tolerance: float = 0.02
    """Largest residual of the anchors, pixels of the source image; 0: every pixel strictly by its camera."""
    tile: int = 512
    """Side of a tile, pixels; a multiple of 16 from 128 on."""
    true: bool = False
    """Whether orthophotos show the project's objects where they stand; else the ground alone is what is painted."""
    hidden: Hidden | None = None
    """What becomes of places that the image cannot see, since ground or objects are in the way: ``show`` paints them
    with what hides them, without asking; ``nodata`` leaves them empty; ``mark`` paints them and writes where they are.
    None becomes ``nodata`` in true orthophotos and ``show`` in others."""
    nodata: str = "auto"
    """A number, ``mask`` (an internal mask band), or ``auto``: 0 for unsigned integers, −32768 for int16, NaN for
    floats."""
    compress: Compression = "deflate"
    """Compression of the file; jpeg needs ``nodata = "mask"`` and sets it."""
    overviews: bool = True
    """Whether the file holds overviews."""
    choice: Choice | None = None
    """How images are chosen for one mosaic of them; None: an orthophoto of each."""
    accuracy: bool = False
    """Whether a second raster holds the standard deviations of what each pixel shows; all errors must be stated."""
    method: Method = "indirect"
    """``indirect``: every pixel of the product is looked up in the image; ``direct``: every pixel of the image is
    carried to the ground."""
    fill: int = 0
    """Gaps that the direct method leaves are filled from pixels no further away than this; 0: they stay empty."""
    fill_hidden: int = 0
    """Hidden holes up to this width and height, pixels, are filled: from an image whose line of sight is only just
    blocked, else from the pixels around them. The raster of `sources` marks them; 0: they stay empty."""
    sources: bool = False
    """Whether a second raster says which image painted each pixel, and a GeoPackage where its regions are."""
    stack: str = ""
    """Name of a virtual raster that shows all orthophotos as bands of one, on the same ground: lines of one camera, of
    other colours; empty: there is none."""

    @property
    def exactness(self) -> str:
        """How exactly positions are computed, in words."""
        return f"tolerance {self.tolerance:g} px" if self.tolerance else "every pixel strictly by its camera"

    def __post_init__(self) -> None:
        if self.resolution is not None:
            check_resolution(self.resolution)
        if self.hidden is None:
            object.__setattr__(self, "hidden", "nodata" if self.true or self.method == "direct" else "show")
        if self.kernel not in get_args(Kernel):
            raise UsageError(f"kernel {self.kernel!r}; allowed are {', '.join(get_args(Kernel))}")
        names = ("compression", self.compress, Compression), ("hidden", self.hidden, Hidden)
        for what, value, allowed in (*names, ("method", self.method, Method)):
            if value not in get_args(allowed):
                raise UsageError(f"{what} {value!r}; allowed are {', '.join(get_args(allowed))}")
        if not (self.tolerance == 0 or 1e-6 <= self.tolerance <= 10):
            raise UsageError(
                f"tolerance {self.tolerance} px; it must be 0 (every pixel strictly by its camera) or 1e-6 to 10 "
                "(usual is 0.02)"
            )
        if self.tile < 128 or self.tile > 4096 or self.tile % 16:
            raise UsageError(f"tile side {self.tile}; allowed are multiples of 16 from 128 to 4096")
        if self.bounds is not None:
            object.__setattr__(self, "bounds", tuple(float(b) for b in self.bounds))
        if self.nodata not in ("auto", "mask"):
            try:
                float(self.nodata)
            except ValueError:
                raise UsageError(f"nodata {self.nodata!r}; allowed are auto, mask or a number") from None

        if not 0 <= self.fill <= MOST_FILLED or (self.fill and self.method != "direct"):
            raise UsageError(f"`fill` {self.fill}; allowed are 0 to {MOST_FILLED} pixels, with `method` direct")
        if self.method == "direct" and (self.choice is not None or self.accuracy or self.hidden != "nodata"):
            raise UsageError(
                "`method` direct makes orthophotos of single images, paints no hidden ground and knows no `accuracy`: "
                "leave `hidden` and `accuracy` out, or take the indirect method"
            )
        if type(self.fill_hidden) is not int or not 0 <= self.fill_hidden <= MOST_FILLED:
            raise UsageError(
                f"`fill_hidden` {self.fill_hidden!r}; must be a whole number from 0 to {MOST_FILLED} pixels"
            )
        if self.fill_hidden and (self.hidden != "nodata" or self.method == "direct"):
            raise UsageError(
                f"`fill_hidden` {self.fill_hidden} fills hidden ground that is left empty; it requires `hidden` nodata "
                f"(found {self.hidden}) and `method` indirect (found {self.method})"
            )
        if self.fill_hidden:
            # Filled pixels are never without their mark.
            object.__setattr__(self, "sources", True)

        if self.stack and self.choice is not None:
            raise UsageError(f"`stack` {self.stack!r} shows orthophotos as bands; a mosaic is one picture already")

    @property
    def asks_hidden(self) -> bool:
        """Whether it is looked what images cannot see."""
        return self.hidden != "show" or self.choice is not None

    @property
    def filling(self) -> str:
        """Which hidden holes are filled, in words; empty if none are."""
        return f", hidden holes up to {self.fill_hidden} px filled" if self.fill_hidden else ""

    @property
    def nodata_value(self) -> float | Literal["auto", "mask"]:
        """`nodata` as the product's writer takes it."""
        return self.nodata if self.nodata in ("auto", "mask") else float(self.nodata)  # type: ignore[return-value]

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> OrthoSettings:
        """Settings from plain values, by name."""
        known = {f.name for f in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise UsageError(f"unknown settings {', '.join(unknown)}; known are {', '.join(sorted(known))}")
        choice = values.get("choice")
        return cls(**{**values, "choice": Choice.from_dict(choice) if isinstance(choice, dict) else choice})
