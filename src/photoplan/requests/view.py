"""Requests of perspective views: pictures, sequences, coordinate matrices, and what is measured in them."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from photoplan.errors import InputError, UsageError
from photoplan.request import DRY_RUN, EXECUTOR, MEMORY, ONE_WORKER, OVERWRITE, WORKERS, Request, arg, crs_option, opt
from photoplan.terrain.shading import Lighting

Colour = tuple[int, int, int]
#: Coefficient of refraction that is usual by day (Ecker 1991, §5.7.6).
USUAL_REFRACTION = 0.13
#: Keys of lines that are drawn.
KEYS = ("colour", "width", "dash", "label", "height", "distance", "rank", "crs", "drape")
#: Sides of pictures, pixels.
_LARGEST = 200_000
#: What the camera of an image has of its own.
_OF_STANDPOINT = ("height", "altitude", "look_at", "azimuth", "pitch", "roll", "field_of_view", "size", "pixel_aspect",
                  "panorama")  # fmt: skip


class CameraRequest(Request):
    """Camera of a view: angles in degrees, lengths in metres."""

    image: str | None = opt("Image of the project, or a TOML file of the options below.", None, flag="camera",
                            metavar="IMAGE|FILE", section="input")  # fmt: skip
    aside: float | None = None
    """Distance by which the camera of an image is moved to the right along its rows, metres: an eye of a pair."""
    position: tuple[float, float] | None = opt("Standpoint.", None, flag="from", metavar="X Y")
    height: float = opt("Height of the eye above ground, metres [1.7].", 1.7)
    altitude: float | None = opt(
        "Height of the eye in the height system of the terrain, instead of above ground.", None
    )
    look_at: tuple[float, ...] | None = opt("Ground point in the middle of the rendering.", None, nargs=2,
                                            metavar="X Y")  # fmt: skip
    look_at_height: float | None = opt("Height of that point, if it is not on the ground.", None)
    azimuth: float | None = opt("Direction of view, instead of a point, degrees from grid north.", None)
    pitch: float = opt("Angle of view above the horizon, degrees, together with an azimuth [0].", 0.0)
    roll: float = opt("Angle of the camera about its axis, degrees clockwise [0].", 0.0)
    field_of_view: float | None = opt("Angle from left to right, degrees [60; panoramas 360].", None, flag="fov")
    size: tuple[int, int] = opt("Size of the rendering, pixels [1200 800].", (1200, 800), metavar="W H")
    pixel_aspect: float = opt("Width of a pixel by its height [1].", 1.0)
    panorama: Literal["cylinder", "sphere"] | None = opt("Kind of panorama, instead of a plane rendering.", None)
    curvature: Literal["none", "bend", "strict"] | None = opt(
        "The earth: flat, lowered by s²/2R, or strict [standpoints bend, images as the project has it].", None
    )
    refraction: float | None = opt("Coefficient of refraction k [0.13].", None)
    earth_radius: float | None = opt("Radius of the earth, metres [the ellipsoid's].", None)
    exaggeration: float = opt("Factor by which heights are multiplied [1].", 1.0)
    reference: float | None = opt(
        "Height that the exaggeration leaves unchanged [that of the ground in the middle].", None
    )

    def check(self) -> None:
        """Refuse what does not go together, and what cannot be meant; a file of a camera is judged when it is read."""
        from photoplan.cameras.curvature import Exaggeration
        from photoplan.geometry.bounds import odd_angles, odd_place
        from photoplan.geometry.grid import USUAL_TILE, refuse_absurd

        if self.look_at_height is not None:
            if self.look_at is None:
                raise UsageError("`look_at_height` requires `look_at` X Y")
            object.__setattr__(self, "look_at", (*self.look_at[:2], self.look_at_height))
            object.__setattr__(self, "look_at_height", None)
        if self.is_file:
            return
        if self.image is not None and self.position is not None:
            raise UsageError("a view requires a `camera`, an image of the project, or a standpoint `position` X Y")
        declared = type(self).model_fields
        own = [name for name in _OF_STANDPOINT if getattr(self, name) != declared[name].default]
        if self.image is not None and own:
            raise UsageError(f"`{own[0]}` requires a standpoint `position`; an image is seen with its own camera")
        if self.aside is not None and self.image is None:
            raise UsageError("`aside` requires the camera of an image; a standpoint is moved by its `position`")
        odd = odd_angles((self.azimuth or 0.0, self.roll), "deg", ("`azimuth`", "`roll`"))
        far = odd_place((0.0, 0.0, self.reference or 0.0), camera=True)
        if odd is not None or far is not None:
            raise UsageError(odd or f"`reference`: {far}")
        if self.panorama and self.look_at is None and self.azimuth is None:
            object.__setattr__(self, "azimuth", 0.0)
        if self.position is not None and (self.look_at is None) == (self.azimuth is None):
            raise UsageError("a standpoint requires either `look_at` X Y [Z] or `azimuth`")
        if self.look_at is not None and len(self.look_at) not in (2, 3):
            raise UsageError(f"`look_at` {self.look_at} must be X Y or X Y Z")
        most = 360.0 if self.panorama else 170.0
        if self.field_of_view is not None and not 1e-4 <= self.field_of_view <= most:
            raise UsageError(f"`field_of_view` {self.field_of_view}° must be from 0.0001 to {most:g}")
        if not all(1 <= side <= _LARGEST for side in self.size):
            raise UsageError(f"`size` {self.size[0]} × {self.size[1]} pixels must have sides from 1 to {_LARGEST}")
        refuse_absurd(self.size, USUAL_TILE, "the rendering")
        if not 0.01 <= self.pixel_aspect <= 100:
            raise UsageError(f"`pixel_aspect` {self.pixel_aspect} must be from 0.01 to 100")
        if self.refraction is not None and not -1 <= self.refraction < 1:
            raise UsageError(f"`refraction` {self.refraction} must be from -1 to below 1, usually {USUAL_REFRACTION}")
        if self.earth_radius is not None and not 1e6 <= self.earth_radius <= 1e8:
            raise UsageError(f"`earth_radius` {self.earth_radius} m is not a radius of the earth (about 6380000)")
        if self.exaggeration != 1.0:
            Exaggeration(0.0, self.exaggeration)
        if not abs(self.pitch) <= 90:
            raise UsageError(f"`pitch` {self.pitch}° must be from -90 to 90")

    @property
    def is_file(self) -> bool:
        """True if a file states the camera."""
        return self.image is not None and self.image.lower().endswith(".toml")

    def read(self) -> Self:
        """Return the camera of its file, with the options that are set beside it; itself if no file states it."""
        if not self.is_file:
            return self
        file = str(self.image)
        try:
            stated = tomllib.loads(Path(file).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{file}: is no file of a camera ({error})") from error
        given = {name: getattr(self, name) for name in self.model_fields_set if name not in ("image", "look_at_height")}
        return self.from_dict({**stated, **given}, file)

    @classmethod
    def from_dict(cls, values: dict[str, Any], where: str) -> Self:
        """Return the camera of plain values, as a file has them; `where` names it in errors."""
        for name in values:
            if name not in cls.model_fields:
                known = ", ".join(cls.model_fields)
                raise InputError(f"{where}: {name!r} is no part of a camera; known are {known}")
        try:
            made = cls(**values)
        except (TypeError, UsageError) as error:
            raise InputError(f"{where}: {str(error).replace('`', '')}") from error
        if made.is_file:
            raise InputError(f"{where}: image = {made.image!r} names another file; state the camera itself")
        return made

    def json_fields(self) -> dict[str, Any]:
        """Return the camera by name; `look_at` holds its height."""
        return {name: value for name, value in dict(self).items() if name != "look_at_height"}


class PathCameraRequest(CameraRequest):
    """Camera of a sequence but for its standpoint."""

    def check(self) -> None:
        """Refuse a standpoint, which the path states."""
        if self.image is not None or self.position is not None:
            raise UsageError("standpoints of a sequence are those of its `path`; set neither `camera` nor `position`")
        super().check()


@dataclass(frozen=True)
class ContentRequest:
    """One layer of what a view shows; later ones lie over earlier ones."""

    kind: str
    """`shade`, `tint`, `slope`, `raster`, `photo` or `photos`."""
    value: str = ""
    """File of a raster, name of a photo, or ramp of tints with its lowest and highest height."""
    opacity: float = 1.0
    classes: bool = False
    """True if the values of a raster are numbers of classes, whatever its file states."""

    def __post_init__(self) -> None:
        if not 0 < self.opacity <= 1:
            raise UsageError(f"content {self.value or self.kind}: opacity {self.opacity} must be above 0 and at most 1")

    @classmethod
    def parse(cls, text: str) -> ContentRequest:
        """Read ``WHAT`` or ``WHAT@OPACITY``: ``shade``, ``slope``, ``photos``, ``photo:NAME``, ``tint``,
        ``tint:RAMP``, ``tint:RAMP:LOW:HIGH``, or the file of a raster, with ``@classes`` if its values are classes.
        """
        opacity, classes = 1.0, False
        while "@" in text and not Path(text).exists():
            head, _, tail = text.rpartition("@")
            try:
                classes, opacity = (True, opacity) if tail == "classes" else (classes, float(tail))
            except ValueError:
                break
            text = head
        kind, _, value = text.partition(":")
        known = "" if kind in ("shade", "slope", "photos") and not value else None
        known = value if kind == "tint" or (kind == "photo" and value) else known
        if known is not None:
            if classes:
                raise UsageError(f"content {text}@classes: only the file of a raster has classes; leave `@classes` out")
            return cls(kind, known, opacity)
        if not Path(text).is_file():
            raise UsageError(
                f"content {text!r} must be a file, or shade, slope, tint, tint:RAMP:LOW:HIGH, photos "
                "or photo:NAME, each with or without @OPACITY, files also with @classes"
            )
        return cls("raster", text, opacity, classes)


@dataclass(frozen=True)
class LinesRequest:
    """A layer that is drawn: a file of features, or contours."""

    path: Path | None
    """File of features; None for contours of the terrain."""
    layer: str | None = None
    interval: float = 0.0
    """Interval of contours, metres."""
    options: tuple[tuple[str, str], ...] = ()
    """Keys of `KEYS`, each a value or the name of an attribute."""

    @classmethod
    def parse(cls, text: str) -> LinesRequest:
        """Read ``FILE``, ``FILE:LAYER`` or ``contours:INTERVAL``, each with ``@KEY=VALUE,KEY=VALUE``."""
        head, _, tail = text.rpartition("@") if "=" in text.rpartition("@")[2] else (text, "", "")
        pairs = [tuple(part.strip() for part in each.split("=", 1)) for each in tail.split(",")] if tail else []
        wrong = [each for each in pairs if len(each) != 2 or each[0] not in KEYS]
        if wrong:
            raise UsageError(f"lines {text!r}: {'='.join(wrong[0])!r} must be KEY=VALUE with one of {', '.join(KEYS)}")
        options = tuple((key, value) for key, value in pairs)
        kind, _, value = head.partition(":")
        if kind == "contours" and not Path(head).is_file():
            return cls(None, None, number_in(value, f"lines {text!r}: interval", 1e-3, 1e5), options)
        if Path(head).is_file():
            return cls(Path(head), None, 0.0, options)
        file, _, layer = head.rpartition(":")
        if not (file and layer and Path(file).is_file()):
            raise UsageError(f"lines {text!r} must be FILE, FILE:LAYER or contours:INTERVAL; there is no such file")
        return cls(Path(file), layer, 0.0, options)


def number_in(text: str, where: str, least: float, most: float) -> float:
    """Return the number that a text states, if it lies between two others."""
    try:
        value = float(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise InputError(f"{where} {text[:40]!r}; {least:g} to {most:g} is allowed")
    return value


@dataclass(frozen=True)
class PhotoRequest:
    """A photograph that has the pixels of the rendering."""

    path: str
    how: str = "over"
    """`over`, `squares` or `beside`."""
    opacity: float = 0.5
    """Opacity of what lies over the picture."""

    def __post_init__(self) -> None:
        if self.how not in ("over", "squares", "beside"):
            raise UsageError(f"photo {self.path}: {self.how!r} must be over, squares, beside, or an opacity")
        if not 0 < self.opacity <= 1:
            raise UsageError(f"photo {self.path}: opacity {self.opacity} must be above 0 and at most 1")

    @classmethod
    def parse(cls, text: str) -> PhotoRequest:
        """Read ``FILE``, ``FILE@OPACITY``, ``FILE@squares`` or ``FILE@beside``."""
        head, _, tail = text.rpartition("@")
        if not head or Path(text).is_file():
            return cls(text)
        try:
            return cls(head, "over", float(tail))
        except ValueError:
            return cls(head, tail)


def _colour(help: str, default: Colour) -> Any:
    return opt(help, default, metavar="R G B")


class LookRequest(Request):
    """Options of how a view looks."""

    contents: tuple[ContentRequest, ...] = opt(
        "Content to show: `shade`, `tint[:RAMP[:LOW:HIGH]]`, `slope`, `photos`, `photo:NAME`, or a raster on the map. "
        "May be repeated, later ones over earlier ones, with @OPACITY; rasters of classes with @classes "
        "[`tint`, `shade@0.8`; for a project `photos`].",
        (ContentRequest("tint"), ContentRequest("shade", "", 0.8)), flag="content", metavar="WHAT"
    )  # fmt: skip
    sun: tuple[float, float] = opt("Direction of the sun from grid north, and its height, degrees [315 45].",
                                   (315.0, 45.0), metavar="AZIMUTH ALTITUDE")  # fmt: skip
    shadows: bool = opt("Show the shadows of terrain and objects.", False)
    haze: float = opt("Coefficient of haze, per kilometre [0; 0.1 is much].", 0.0)
    haze_colour: Colour = _colour("Colour of the horizon in haze [200 210 222].", (200, 210, 222))
    sky: Colour = _colour("Colour of the sky [186 212 238].", (186, 212, 238))
    nodata: Colour = _colour("Colour of ground that no content shows [214 214 214].", (214, 214, 214))
    water_colour: Colour = _colour("Colour of water that no raster or image shows [112 150 184].", (112, 150, 184))
    samples: int = opt("Rays along each side of a pixel [2].", 2)
    kernel: str = opt("nearest, bilinear, bicubic, bicubic-1 or lanczos3 [bicubic].", "bicubic")
    tolerance: float = opt(
        "Largest error of positions in rasters and images, pixels; 0 if every pixel is computed strictly [0.02].",
        0.02,
        nan=True,
        metavar="PX",
    )

    def check(self) -> None:
        """Refuse what cannot be meant."""
        if not 0 <= self.haze <= 100:
            raise UsageError(f"`haze` {self.haze} per kilometre must be from 0 to 100; 0.1 is much")
        if not 1 <= self.samples <= 8:
            raise UsageError(f"`samples` {self.samples} must be from 1 to 8 rays along each side of a pixel")
        if not (self.tolerance == 0 or 1e-6 <= self.tolerance <= 10):
            raise UsageError(
                f"`tolerance` {self.tolerance} px; it must be 0 (every pixel strictly) or 1e-6 to 10 (usual is 0.02)"
            )
        for name in ("haze_colour", "sky", "nodata", "water_colour"):
            if not all(0 <= v <= 255 for v in getattr(self, name)):
                raise UsageError(f"`{name}` {getattr(self, name)} must be red, green and blue from 0 to 255")
        self.light()

    def light(self, exaggeration: float = 1.0) -> Lighting:
        """Return the light of the sun on heights that are exaggerated."""
        return Lighting(azimuth=self.sun[0], altitude=self.sun[1], exaggeration=exaggeration)

    def json_fields(self) -> dict[str, Any]:
        """Return the options by name, the sun by its two angles."""
        rest = {name: value for name, value in dict(self).items() if name not in ("contents", "sun")}
        return {"contents": self.contents, "azimuth": self.sun[0], "altitude": self.sun[1], **rest}


@dataclass(frozen=True)
class Stereo:
    """A pair of pictures."""

    how: str
    """`side-by-side`: left and right beside each other, or `anaglyph` for red and cyan glasses."""
    base: float | None = None
    """Distance of both cameras, metres; None: a thirtieth of the distance of the nearest ground."""

    @property
    def beside(self) -> bool:
        """True if both pictures lie next to each other."""
        return self.how == "side-by-side"

    @property
    def metres(self) -> float:
        """The base, which must be stated."""
        assert self.base is not None
        return self.base

    def stated(self, nearest: float | None) -> Stereo:
        """Return it with a number as base, rounded to two digits; `nearest`: distance of the nearest ground, metres."""
        if self.base is not None:
            return self
        if nearest is None:
            raise UsageError("no ground is seen from which a `base` would follow; set it")
        return Stereo(self.how, float(f"{nearest * (1 / 30):.2g}"))


class SightRequest(Request):
    """Options that all views have: the terrain or project, and the camera."""

    source: Path = arg("Project file or terrain model.")
    camera: CameraRequest | None = None
    farthest: float = opt("Largest distance that is seen, metres [all].", math.inf, infinite=True)
    bound: float = opt("Largest error of ground coordinates, metres [0.01].", 0.01)
    water: float | None = opt(
        "Height of the water that covers lower ground and places without height.", None, nan=True, metavar="H"
    )
    crs: str | None = crs_option("a terrain model that does not state it")
    force: bool = opt("Continue although the eye is below the ground, or no ground is seen.", False, section="run")


class MatrixRequest(SightRequest):
    """Options of the ground of every pixel of a view."""

    output: Path = opt("Matrix to write.", metavar="TIF", writes=True)
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE


class PictureOptions(SightRequest):
    """Options of single pictures and of sequences of them."""

    look: LookRequest = LookRequest()
    lines: tuple[LinesRequest, ...] = opt(
        "FILE[:LAYER] of points and lines, or contours:INTERVAL; may be repeated. With "
        "@colour=#d55e00,width=2,dash=6-3,label=name,height=yes,distance=yes,rank=field,drape=yes.", (), metavar="WHAT"
    )  # fmt: skip
    text_size: float = opt("Size of labels, pixels.", 13.0)
    stereo: Literal["side-by-side", "anaglyph"] | None = opt("Kind of stereo pair: side by side, or red-cyan.", None)
    base: float | None = opt(
        "Distance between the eyes, metres [a thirtieth of the distance to the nearest ground].", None
    )
    lettering: Any = None
    """Function that draws texts; None if points have no labels."""
    dry_run: bool = DRY_RUN
    workers: int = ONE_WORKER
    executor: str = EXECUTOR
    memory: int | None = MEMORY
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse what does not go together."""
        if self.base is not None and self.stereo is None:
            raise UsageError("`base` requires `stereo`")
        if self.base is not None and not self.base > 0:
            raise UsageError(f"`base` {self.base} m must be positive")
        if not 4 <= self.text_size <= 400:
            raise UsageError(f"`text_size` {self.text_size} pixels must be from 4 to 400")

    @property
    def pair(self) -> Stereo | None:
        """The pair of pictures; None if there is one picture."""
        return None if self.stereo is None else Stereo(self.stereo, self.base)


class ViewRequest(PictureOptions):
    """Options of a picture."""

    matrix: Path | None = opt(
        "Coordinate matrix of this view, of which only the content is rendered again.", None, section="input"
    )
    output: Path | None = opt(
        "Rendering to write: PNG, JPEG or GeoTIFF; a dry run requires none.", None, metavar="PICTURE", writes=True
    )
    photo: PhotoRequest | None = opt(
        "Photograph with the pixels of the rendering, shown over it with an opacity (@0.3; 0.5), in @squares with it, "
        "or @beside it.",
        None,
        metavar="FILE[@HOW]",
        section="input",
    )
    svg: Path | None = opt("Write lines and labels also as a layer over the rendering.", None, writes=True)
    kind: Literal["picture", "matrix"] = "picture"

    def check(self) -> None:
        """Refuse what does not go together."""
        super().check()
        if self.stereo is not None and (self.matrix or self.svg or self.photo or self.kind == "matrix"):
            raise UsageError("a stereo pair has two cameras; leave out matrix, `photo` and `svg`")
        if self.svg is not None and not self.lines:
            raise UsageError(f"{self.svg}: `svg` requires `lines`")
        if self.svg is not None and self.svg.suffix.lower() != ".svg":
            raise UsageError(f"{self.svg}: must end with .svg")


class SequenceRequest(PictureOptions):
    """Options of pictures along a path."""

    camera: PathCameraRequest | None = None
    path: Path = opt("Stations: a table x, y, z; or points, or a line of a GeoPackage, GeoJSON, Shapefile or DXF.",
                     metavar="FILE", section="input")  # fmt: skip
    layer: str | None = opt("Layer of the path's file.", None, section="input")
    step: float | None = opt("Distance of stations of a line, metres.", None)
    video: Path | None = opt("Write a film of the renderings; requires ffmpeg.", None, metavar="MP4", writes=True)
    rate: float = opt("Renderings of the film per second.", 25.0, section="result")
    output: Path = opt("Folder for frame_00001.png and so on.", metavar="FOLDER", folder=True, section="result")

    def check(self) -> None:
        """Refuse a film that cannot be."""
        super().check()
        if self.video is not None and self.video.suffix.lower() != ".mp4":
            raise UsageError(f"{self.video}: must end with .mp4")
        if not 0.1 <= self.rate <= 240:
            raise UsageError(f"`rate` {self.rate} must be from 0.1 to 240 renderings per second")
        if self.stereo is not None and self.base is None:
            raise UsageError("pairs of a sequence require one `base`")

    @property
    def along(self) -> bool:
        """True if it looks along the path: neither a point nor a direction is set."""
        return self.camera is None or not self.camera.model_fields_set & {"look_at", "azimuth"}


class MeasuringRequest(SightRequest):
    """Options that all measurements in views have."""

    matrix: Path | None = opt("Take the camera of this coordinate matrix.", None, section="input")


class AreaRequest(MeasuringRequest):
    """Options of the visible area."""

    output: Path = opt("GeoTIFF, or GeoPackage of a polygon.", metavar="FILE", writes=True)
    resolution: float | None = opt("Pixel of the map, metres [a thousandth of its side].", None, gt=0)
    workers: int | None = WORKERS
    overwrite: bool = OVERWRITE


class PickRequest(MeasuringRequest):
    """Options of pixels to ground and ground to pixels."""

    pixels: tuple[tuple[float, float], ...] = opt("Pixel; may be repeated.", (), flag="pixel", metavar="COLUMN ROW",
                                                  section="input")  # fmt: skip
    points: tuple[tuple[float, ...], ...] = opt("Ground point; may be repeated.", (), flag="ground", nargs=2,
                                                metavar="X Y", section="input")  # fmt: skip
    file: Path | None = opt("Ground points: columns x, y and optionally z, name.", None, flag="points",
                            metavar="TABLE", section="input")  # fmt: skip
    output: Path | None = opt("Table of the points to write.", None, metavar="CSV", writes=True)
    overwrite: bool = OVERWRITE


class SkylineRequest(MeasuringRequest):
    """Options of a skyline, and of a photograph that it is compared with."""

    output: Path = opt("CSV, or GeoPackage of points.", metavar="FILE", writes=True)
    photo: Path | None = opt(
        "Photograph with the pixels of the rendering, whose edge of the sky is compared.",
        None,
        metavar="IMAGE",
        section="input",
    )
    border: int = opt("Width of the frame of the photograph that shows no scene, pixels [0].", 0)
    search: int | None = opt("Rows above and below the skyline to look for the edge [a tenth].", None)
    control: Path | None = opt("Points of the photograph: x, y, E, N, H, name.", None, metavar="TABLE",
                               section="input")  # fmt: skip
    picture: Path | None = opt("Write the photograph with both lines.", None, metavar="PNG", writes=True)
    refine: bool = opt("Turn the camera until both lines agree.", False)
    focal: bool = opt("Estimate also the camera constant.", False)
    refined: Path | None = opt("Write the camera that was found.", None, metavar="TOML", writes=True)
    overwrite: bool = OVERWRITE

    def check(self) -> None:
        """Refuse what a photograph, or a camera that is turned, is needed for."""
        of_photo = ("border", "search", "control", "picture", "refine", "focal", "refined")
        given = [name for name in of_photo if name in self.model_fields_set and getattr(self, name) is not None]
        if given and self.photo is None:
            raise UsageError(f"`{given[0]}` requires `photo`")
        for name in ("focal", "refined"):
            if getattr(self, name) and not self.refine:
                raise UsageError(f"`{name}` requires `refine`")
        if self.border < 0 or (self.search is not None and self.search < 2):
            raise UsageError(f"`border` {self.border} must be at least 0 pixels, `search` {self.search} at least 2")
        for path, suffix in ((self.picture, ".png"), (self.refined, ".toml")):
            if path is not None and path.suffix.lower() != suffix:
                raise UsageError(f"{path}: must end with {suffix}")
