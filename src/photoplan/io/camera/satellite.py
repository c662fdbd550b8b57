"""Sensor models of satellite images: rational polynomials (RPC), and support data (ISD) of the Community Sensor Model.

Rational polynomials (RPC00B) of satellite images, from the files that they are delivered in.

Every format is a way to the texts of ten offsets and scales and of 80 coefficients, by the names that GDAL uses.

Support data of the Community Sensor Model (ISD, JSON): entries, lenses, and frame cameras of planetary missions.

Names and meaning are those of the USGS's tools (ale, usgscsm; public domain). Positions and attitudes are those of an
inertial frame, the body turns in it by a table of its own. Quaternions are scalar first and lead from the inertial
frame to the camera and to the body.

With u without and d with distortion in the focal plane, both in millimetres, r² = x² + y² (usgscsm, `Distortion.cpp`;
names are its own):

    radial      u = d (1 − k0 − k1 r² − k2 r⁴), r of d
    transverse  dx, dy = cubic polynomials of u with ten coefficients each, in the order of `Cubic`
    dawnfc      d = u (1 + k r²), r of u
    radtan      d / f = OpenCV's lens of u / f: k1, k2, p1, p2, k3

Cameras look along z; x and y of the focal plane, millimetres, lead to lines and samples of the detector from the outer
corner of its first pixel, so that the middle of that pixel is at 0.5. Line and sample of the image are those of the
detector less the first that was read, over how many were summed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import rasterio

from photoplan.arrays import Floats
from photoplan.cameras.fiducials import Affine2D
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.framed import BodyFrameCamera
from photoplan.cameras.lenses import Brown, Cubic, Interior, Lens, NoLens, OpenCV, Reversed
from photoplan.cameras.pushbroom_rays import to_sphere
from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.geometry.local import BodyGround
from photoplan.geometry.pose import FLIP, Pose, between, conjugate, cubic, odd_step, quaternions, rotations, times
from photoplan.io.disk import gdal_settings, not_georeferenced
from photoplan.io.files import format_hint, read_head, read_json, read_text, read_xml
from photoplan.io.raster_info import read_info

#: Nothing that holds 90 numbers and what belongs to an image is larger.
MAX_BYTES = 20_000_000
_AXES = ("SAMP", "LINE", "LONG", "LAT", "HEIGHT")
_SINGLE = tuple(f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in _AXES)
_GROUPS = ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF")
#: Names in ``.RPB``: sampOffset, sampNumCoef.
_RPB = {f"{axis}_{key}": axis.lower() + own for key, own in (("OFF", "Offset"), ("SCALE", "Scale")) for axis in _AXES}
_RPB |= {name: f"{name[:4].lower()}{name[5:8].title()}Coef" for name in _GROUPS}
#: Names in the XML of DigitalGlobe: SAMPOFFSET, SAMPNUMCOEFList/SAMPNUMCOEF.
_MAXAR = {name: name.replace("_OFF", "OFFSET").replace("_SCALE", "SCALE") for name in _SINGLE}
_MAXAR |= {name: "{0}List/{0}".format(name.replace("_", "")[:-1]) for name in _GROUPS}
#: Axes in a system product of Pléiades; A is the scale, B the offset.
_DIMAP = {"SAMP": "Col", "LINE": "Row", "LONG": "Lon", "LAT": "Lat", "HEIGHT": "Alt"}
#: Place in RPC00A of every term of RPC00B (NIMA, STDI-0002, section 8.2).
_FROM_A = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)
_MARKS = re.compile(r"LINE_OFF\s*[:=]|lineOffset\s*=|<LINEOFFSET>|<Global_RFM>|<RPB>|<isd>|line_num_coeff_00")
_GEOM = re.compile(r"^\s*(?:[\w.]+\.)?(?:line_num_coeff_00|polynomial_format)\s*:", re.MULTILINE)

_Texts = Mapping[str, str | Sequence[str]]


@dataclass(frozen=True, eq=False)
class StatedRpc:
    """Rational polynomials of a file."""

    file: Path
    form: str
    """The file's format, in words."""
    functions: RationalFunctions

    def describe(self) -> dict[str, str]:
        """Return the middle and the extent on the ground and in the image, in words."""
        (x0, y0), (xs, ys) = self.functions.image_offset, self.functions.image_scale
        (lon, lat, h), (dlon, dlat, dh) = self.functions.ground_offset, self.functions.ground_scale
        return {
            "rational polynomials": f"RPC00B, {self.form}",
            "middle": f"longitude {lon:.5f}°, latitude {lat:.5f}°, height {h:g} m (WGS 84)",
            "ground": f"± {dlon:.5f}°, ± {dlat:.5f}°, heights {h - dh:g} to {h + dh:g} m",
            "image": f"column {x0:g} ± {xs:g}, row {y0:g} ± {ys:g} (0, 0 is the centre of the first pixel)",
        }


def _functions(values: _Texts, where: str, first: float = 0.0) -> RationalFunctions:
    """Return polynomials; the file counts samples and lines from `first` at the centre of the upper-left pixel."""
    missing = [name for name in (*_SINGLE, *_GROUPS) if name not in values]
    if missing:
        raise InputError(
            f"{where}: {', '.join(missing)} missing; RPC00B has ten offsets and scales and 80 coefficients"
        )
    x, y, lon, lat, h, xs, ys, dlon, dlat, dh = (_numbers(values[name], f"{where}: {name}", 1)[0] for name in _SINGLE)
    coefficients = np.array([_numbers(values[name], f"{where}: {name}", 20) for name in _GROUPS])
    try:
        return RationalFunctions(
            image_offset=(x - first, y - first),
            image_scale=(xs, ys),
            ground_offset=(lon, lat, h),
            ground_scale=(dlon, dlat, dh),
            coefficients=coefficients,
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _numbers(given: str | Sequence[str], where: str, count: int) -> list[float]:
    words = given.split() if isinstance(given, str) else list(given)
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{where}: {' '.join(words)[:80]!r} given; {count} numbers are needed") from None
    if len(values) != count or not np.isfinite(values).all():
        told = "a number that is not finite" if len(values) == count else f"{len(values)} values"
        raise InputError(f"{where}: {told} given; {count} finite numbers are needed")
    return values


def _text(path: Path) -> RationalFunctions:
    """Read ``LINE_OFF: +002345.00 pixels``, ``LINE_NUM_COEFF_1: …`` and so on; other lines are passed over."""
    found: dict[str, str] = {}
    for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), 1):
        match = re.match(r"\s*([A-Z_]+(?:_\d+)?)\s*[:=]\s*(\S+)", line)
        if match is None:
            continue
        if match[1] in found:
            raise InputError(f"{path}:{number}: {match[1]} is given twice")
        found[match[1]] = match[2]
    terms = {group: [found[f"{group}_{k}"] for k in range(1, 21) if f"{group}_{k}" in found] for group in _GROUPS}
    single = {name: found[name] for name in _SINGLE if name in found}
    return _functions(single | {group: some for group, some in terms.items() if some}, str(path))


def _geom(path: Path) -> RationalFunctions:
    """Read ``line_off:  2345``, ``line_num_coeff_00: …`` and so on; keys may have a prefix with dots.

    Such keyword lists are written by OSSIM and by Orfeo ToolBox before version 8. Samples and lines are counted from 0;
    ``polynomial_format`` A and B are the orders of terms of RPC00A and RPC00B.
    """
    found: dict[str, str] = {}
    for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), 1):
        match = re.match(r"\s*(?:[\w.]+\.)?(\w+)\s*:\s*(.*?)\s*$", line)
        if match is None:
            continue
        key = match[1].lower()
        if key in found and found[key] != match[2] and key.endswith(("_off", "_scale", "polynomial_format")):
            raise InputError(f"{path}:{number}: {key} is given twice")
        found.setdefault(key, match[2])
    if "line_num_coeff_00" not in found:
        kind = f" of {found['type']}" if "type" in found else ""
        raise InputError(
            f"{path}: states a sensor model{kind} of OSSIM and no rational polynomials; give the file of polynomials "
            "(RPC) that the image was delivered with"
        )
    form = found.get("polynomial_format", "B").strip().upper()
    if form not in ("A", "B"):
        raise InputError(f"{path}: polynomial_format {form!r}; it must be A or B")
    values: dict[str, str | list[str]] = {name: found[name.lower()] for name in _SINGLE if name.lower() in found}
    for group in _GROUPS:
        terms = [found[key] for k in range(20) if (key := f"{group.lower()}_{k:02d}") in found]
        values[group] = [terms[k] for k in _FROM_A] if form == "A" and len(terms) == 20 else terms
    return _functions(values, str(path))


def _rpb(path: Path) -> RationalFunctions:
    """Read ``lineOffset = 2345;``, ``lineNumCoef = ( 1.0E+00, … );`` and so on, as DigitalGlobe writes them."""
    text, values = read_text(path, MAX_BYTES), dict[str, str]()
    for name, own in _RPB.items():
        found = re.findall(rf"\b{own}\s*=\s*\(?([^;()]*)\)?\s*;", text)
        if len(found) > 1:
            raise InputError(f"{path}: {own} is given twice")
        if found:
            values[name] = found[0].replace(",", " ")
    return _functions(values, str(path))


def _maxar(image: Element, where: str) -> RationalFunctions:
    """Read the element ``RPB/IMAGE``."""
    texts = {name: image.findtext(own) for name, own in _MAXAR.items()}
    return _functions({name: text for name, text in texts.items() if text is not None}, where)


def _dimap(model: Element, where: str) -> RationalFunctions:
    """Read the model from the ground to the image of Pléiades, Pléiades Neo and SPOT 6/7, or of a system product.

    All but Pléiades Neo count rows and columns from 1: the centre of the upper-left pixel is (1, 1), as the validity
    domain of the model from the image to the ground says. That from the ground to the image is called inverse (Pléiades
    Imagery User Guide, section 5.2.3); Pléiades Neo (DIMAP 3) calls both by what they do.
    """

    def first(element: Element, *names: str) -> Element | None:
        return next((found for name in names if (found := element.find(name)) is not None), None)

    validity, inverse = model.find("RFM_Validity"), first(model, "Inverse_Model", "GroundtoImage_Values")
    if inverse is None or validity is None:
        missing = "no Inverse_Model (or GroundtoImage_Values) or no RFM_Validity in Global_RFM"
        raise InputError(f"{where}: {missing}; get a fresh copy")
    system, values = inverse.find("F_COL") is not None, dict[str, str | list[str]]()
    for name in _SINGLE:
        axis, what = name.split("_")
        text = validity.findtext(f"{_DIMAP[axis]}/{'A' if what == 'SCALE' else 'B'}" if system else name)
        values |= {} if text is None else {name: text}
    for group in _GROUPS:
        words = [text for k in range(1, 21) if (text := inverse.findtext(f"{group}_{k}")) is not None]
        if system:  # numerator and denominator follow each other in one element
            both = (inverse.findtext("F_COL" if group.startswith("SAMP") else "F_ROW") or "").split()
            words = both[:20] if "NUM" in group else both[20:]
        values |= {group: words} if words or system else {}
    domain = first(validity, "Direct_Model_Validity_Domain", "ImagetoGround_Validity_Domain")
    begins = [None if domain is None else domain.findtext(name) for name in ("FIRST_COL", "FIRST_ROW")]
    from_zero = all((text or "").strip() in ("0", "0.0") for text in begins)
    return _functions(values, where, 0.0 if from_zero else 1.0)


#: Reader and words for every kind of file, by suffix; of XML by an element.
_FILES = {
    ".txt": (_text, "text (_RPC.TXT)"),
    ".rpc": (_text, "text (_RPC.TXT)"),
    ".rpb": (_rpb, "RPB"),
    ".geom": (_geom, "OSSIM keyword list (.geom)"),
}
_ELEMENTS = {
    ".//RPB/IMAGE": (_maxar, "image support data of DigitalGlobe (XML)"),
    ".//Global_RFM": (_dimap, "DIMAP (XML)"),
}
_SUFFIXES = (*_FILES, ".xml")


def read_rpc(path: Path) -> StatedRpc:
    """Read a file (``_RPC.TXT``, ``.RPB``, ``.geom``, XML of DIMAP or DigitalGlobe) or what an image holds itself."""
    suffix = path.suffix.lower()
    if suffix in _FILES:
        read, form = _FILES[".geom" if suffix in (".txt", ".rpc") and _GEOM.search(read_head(path)) else suffix]
        return StatedRpc(path, form, read(path))
    if suffix == ".xml":
        root = read_xml(path, MAX_BYTES)
        for place, (read_element, form) in _ELEMENTS.items():
            element = root.find(place)
            if element is not None:
                return StatedRpc(path, form, read_element(element, str(path)))
        raise InputError(f"{path}: an XML document of <{root.tag}> without rational polynomials")
    found = rpc_in(path)
    if found is None:
        raise InputError(
            f"{path}: the image holds no rational polynomials (RPC); give the file that does ({', '.join(_SUFFIXES)})"
            f"{format_hint(path)}"
        )
    return found


def rpc_in(image: Path) -> StatedRpc | None:
    """Read what an image file holds itself, whatever lies beside it; None if it holds none."""
    alone = gdal_settings(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR")
    driver = read_info(image).driver
    with not_georeferenced(), alone, rasterio.open(image, driver=driver, sharing=False) as file:
        values = file.tags(ns="RPC")
    return StatedRpc(image, "tags of the image file", _functions(values, f"{image}: RPC")) if values else None


def is_rpc(path: Path) -> bool:
    """Return whether a text or XML file speaks of rational polynomials."""
    return path.suffix.lower() in _SUFFIXES and _MARKS.search(read_head(path)) is not None


def rpc_beside(image: Path) -> list[Path]:
    """Return the files of rational polynomials that belong to an image by their names."""
    product = re.sub(r"^IMG_", "RPC_", re.sub(r"_R1C1$", "", image.stem))
    wanted = {f"{image.stem}{end}".casefold() for end in ("_rpc.txt", ".rpc", ".rpb", ".xml", ".geom")}
    wanted |= {f"{product}.xml".casefold()} if product.startswith("RPC_") else set()
    beside = sorted(p for p in image.parent.iterdir() if p.name.casefold() in wanted and p.is_file())
    return [path for path in beside if is_rpc(path)]


def rpc_text(functions: RationalFunctions) -> str:
    """Return the text of a ``_RPC.TXT``; numbers are written so that reading gives the same again."""
    f = functions
    single = zip(_SINGLE, (*f.image_offset, *f.ground_offset, *f.image_scale, *f.ground_scale))
    lines = ["ERR_BIAS: -1", "ERR_RAND: -1", *(f"{name}: {value!r}" for name, value in single)]
    for name, row in zip(_GROUPS, f.coefficients.tolist()):
        lines += [f"{name}_{k}: {value!r}" for k, value in enumerate(row, 1)]
    return "\n".join(lines) + "\n"


FORM = "CSM support data (ISD)"
#: What `name_model` of frame cameras says.
FRAME_MODEL = "USGS_ASTRO_FRAME_SENSOR_MODEL"
#: An image and its tables hold no more than this.
_MAX_SIZE, _MAX_ROWS = 10_000_000, 2_000_000
#: No number of an ISD, in whatever unit, is larger.
_LARGEST = 1e30


@dataclass(frozen=True, eq=False)
class FocalPlane:
    """Positions of detectors, in lines and samples of the whole detector from its outer corner, each (2,)."""

    to_detector: Floats
    """(x, y) in the focal plane, millimetres, to (line, sample), shape (2, 2)."""
    axis: Floats
    """Line and sample of the optical axis."""
    first: Floats
    """Line and sample at which the image begins."""
    focal: float
    """Focal length, millimetres."""


class Isd:
    """Entries of an ISD, checked when they are asked for."""

    def __init__(self, isd: dict[str, Any], path: Path) -> None:
        self._isd, self._path = isd, path
        lines, samples = self.numbers("image_lines", ()), self.numbers("image_samples", ())
        if not (1 <= lines <= _MAX_SIZE and 2 <= samples <= _MAX_SIZE):
            raise InputError(f"{path}: an image of {samples:g} × {lines:g} pixels")
        self.lines, self.samples = int(lines), int(samples)

    def has(self, name: str) -> bool:
        """Return whether an entry (a.b) is there."""
        return self.find(name) is not None

    def numbers(self, name: str, shape: tuple[int, ...]) -> Any:
        """Finite numbers of an entry (a.b) in a shape; −1 stands for any length."""
        found = self.find(name)
        if found is None:
            raise InputError(f"{self._path}: {name} is missing")
        try:
            values = np.array(found, float)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{self._path}: {name} is not a table of numbers") from None
        fits = values.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, values.shape))
        if not fits or not (np.abs(values) <= _LARGEST).all() or values.shape[:1] > (_MAX_ROWS,):
            raise InputError(f"{self._path}: {name} holds numbers of shape {values.shape}, or such as cannot be")
        return values if shape else float(values)

    @property
    def radii(self) -> tuple[float, float]:
        """Equatorial and polar radius, metres."""
        unit = self._unit("radii")
        a, b = (unit * self.numbers(f"radii.{name}", ()) for name in ("semimajor", "semiminor"))
        if not (0 < b <= a):
            raise InputError(f"{self._path}: radii of {a:g} and {b:g} m")
        return a, b

    @property
    def distortion(self) -> str | None:
        """Kind of the optical distortion; None: there is none."""
        kinds = self.find("optical_distortion")
        if kinds is None:
            return None
        return str(next(iter(kinds), "")) if isinstance(kinds, dict) else ""

    def coefficients(self, name: str, count: int) -> list[float]:
        """So many coefficients of the optical distortion; more or fewer have no certain meaning."""
        found = self.numbers(f"optical_distortion.{name}", (-1,))
        if len(found) != count:
            raise InputError(
                f"optical_distortion.{name} has {len(found)} numbers, not {count}: which they are is not said"
            )
        return [float(v) for v in found]

    def focal_plane(self) -> FocalPlane:
        """The focal plane."""
        rows = [self.numbers(f"focal2pixel_{name}", (3,)) for name in ("lines", "samples")]
        A = np.array([row[1:] for row in rows])
        if abs(np.linalg.det(A)) < 1e-12:
            raise InputError("focal2pixel_lines and focal2pixel_samples are parallel")
        centre = np.array([self.numbers(f"detector_center.{name}", ()) for name in ("line", "sample")])
        first = np.array([self.numbers(f"starting_detector_{name}", ()) for name in ("line", "sample")])
        focal = self.numbers("focal_length_model.focal_length", ())
        if not focal > 0:
            raise InputError(f"a focal length of {focal:g} mm")
        return FocalPlane(A, centre + [row[0] for row in rows], first, focal)

    def summing(self, name: str) -> float:
        """Return how many lines or samples ("line", "sample") of the detector are one of the image."""
        found = float(self.numbers(f"detector_{name}_summing", ()))
        if not found > 0:
            raise InputError(f"{self._path}: {found:g} {name}s of the detector in one of the image")
        return found

    def moments(self, name: str) -> Floats:
        """Times of a table, seconds of the ephemeris; rising, in whichever direction the file states them."""
        found = self.numbers(f"{name}.ephemeris_times", (-1,))
        steps = np.diff(found)
        if len(found) < 1 or not ((steps > 0).all() or (steps < 0).all()):
            raise InputError(f"{self._path}: the times of {name} neither rise nor fall throughout")
        return np.sort(found)

    def _of_moments(self, name: str, values: Floats) -> Floats:
        """Rows of a table in the order of its `moments`."""
        found = self.numbers(f"{name}.ephemeris_times", (-1,))
        return values[::-1] if len(found) > 1 and found[0] > found[-1] else values

    def positions(self) -> tuple[Floats, Floats | None]:
        """Positions and velocities of the camera in the inertial frame, metres."""
        unit = self._unit("instrument_position")
        count = len(self.moments("instrument_position"))
        positions = self._of_moments(
            "instrument_position", unit * self.numbers("instrument_position.positions", (count, 3))
        )
        if len(positions) > 2 and (odd := odd_step(self.moments("instrument_position"), positions)) is not None:
            raise InputError(f"{self._path}: instrument_position: {odd}")
        stated = self.has("instrument_position.velocities")
        if not stated:
            return positions, None
        speeds = unit * self.numbers("instrument_position.velocities", positions.shape)
        return positions, self._of_moments("instrument_position", speeds)

    def turns(self, name: str, t: Floats) -> Floats:
        """Quaternions (n, 4) from the inertial frame by a table and its constant rotation, at times (n,)."""
        moments = self.moments(name)
        table = self._of_moments(name, self.numbers(f"{name}.quaternions", (len(moments), 4)))
        length = np.linalg.norm(table, axis=1)
        if (np.abs(length - 1) > 1e-3).any():
            raise InputError(
                f"{self._path}: a quaternion of {name} has the length {length[np.argmax(abs(length - 1))]:g}, not 1"
            )
        turned = between(moments, table / length[:, None], t)
        if not self.has(f"{name}.constant_rotation"):
            return turned
        return times(_quaternion(self.numbers(f"{name}.constant_rotation", (9,)).reshape(3, 3)), turned)

    def _unit(self, name: str) -> float:
        unit = self.find(f"{name}.unit")
        if unit not in (None, "km", "m"):
            raise InputError(f"{self._path}: {name} is stated in {unit!r}; km or m is known")
        return 1.0 if unit == "m" else 1000.0

    def find(self, name: str) -> Any:
        """An entry (a.b) as it stands; None: there is none."""
        found: Any = self._isd
        for word in name.split("."):
            found = found.get(word) if isinstance(found, dict) else None
        return found


def _quaternion(R: Floats) -> Floats:
    """The unit quaternion (4,) of a rotation matrix (3, 3), scalar first."""
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError("a constant rotation is none")
    return quaternions(R[None])[0]


def lens_of(isd: Isd, kind: str | None) -> tuple[float, Lens]:
    """The camera constant, millimetres, and the lens by its tangents, of one of `LENSES`; None: there is none."""
    f = isd.focal_plane().focal
    return (f, NoLens()) if kind is None else LENSES[kind](isd, f)


def not_known(kind: str, known: list[str]) -> InputError:
    """Return the error for another distortion."""
    return InputError(
        f"the distortion {kind!r} is not known; {', '.join(known)} are. Where all its coefficients are 0, or are "
        "not needed, take optical_distortion out of the file"
    )


def _radial(isd: Isd, f: float) -> tuple[float, Lens]:
    # As usgscsm reads them: the first is the constant part, and those that are not there are 0.
    found = [float(v) for v in isd.numbers("optical_distortion.radial.coefficients", (-1,))]
    if not found or any(found[3:]):
        raise InputError(
            f"optical_distortion.radial.coefficients has {len(found)} numbers; 1 to 3 are known (k0, k1, k2), and more "
            "must be 0"
        )
    k0, k1, k2 = (*found, 0.0, 0.0)[:3]
    if not k0 < 1.0:
        raise InputError(f"radial distortion with a constant part of {k0:g}")
    # The constant part changes the scale of the image, and nothing else.
    c = f / (1.0 - k0)
    lens = Brown.from_image_units(c, k=(-k1 / (1.0 - k0), -k2 / (1.0 - k0)))
    return c, Reversed(lens) if k1 or k2 else NoLens()


def _transverse(isd: Isd, f: float) -> tuple[float, Lens]:
    x, y = (tuple(isd.coefficients(f"transverse.{axis}", 10)) for axis in "xy")
    return f, Cubic.from_y_down(f, x, y)


def _dawn(isd: Isd, f: float) -> tuple[float, Lens]:
    return f, Brown.from_image_units(f, k=tuple(isd.coefficients("dawnfc.coefficients", 1)))


def _radtan(isd: Isd, f: float) -> tuple[float, Lens]:
    k1, k2, p1, p2, k3 = isd.coefficients("radtan.coefficients", 5)
    return f, OpenCV(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)


#: Camera constant and lens of every distortion that is a lens.
LENSES: dict[str, Callable[[Isd, float], tuple[float, Lens]]] = {
    "radial": _radial,
    "transverse": _transverse,
    "dawnfc": _dawn,
    "radtan": _radtan,
}


#: Support data of a frame are small.
_MAX_BYTES = 20_000_000
#: Suffixes of support data.
SUFFIXES = (".json", ".isd")


@dataclass(frozen=True, eq=False)
class StatedFrame:
    """A frame camera with its orientation, as a file states them."""

    file: Path
    frame: FrameCamera
    """In the axes of the body."""
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres."""
    focal: float
    """Focal length, millimetres."""
    distortion: str | None
    """Its name; None: there is none."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.frame.size

    def camera(self, crs: str, heights: str) -> BodyFrameCamera:
        """The camera over a ground; a CRS of another body is an InputError."""
        return BodyFrameCamera(self.frame, BodyGround(crs, heights, self.radii))

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        x, y = self.size[0] / 2.0 - 0.5, self.size[1] / 2.0 - 0.5
        d = self.frame.rays(np.array([(x - 0.5, y), (x + 0.5, y)]))[1]
        away = float(np.linalg.norm(self.frame.center))
        return {
            "frame camera": FORM,
            "image": f"{self.size[0]} columns, {self.size[1]} lines",
            "focal length": f"{self.focal:.6g} mm, distortion {self.distortion or 'none'}",
            "directions": f"{1e6 * float(np.linalg.norm(d[1] - d[0])):.4g} µrad from column to column in the middle",
            "position": f"{away / 1000:.3f} km from the middle of the body",
            "body": f"radii {self.radii[0] / 1000:.3f} and {self.radii[1] / 1000:.3f} km",
        }


def read_frame(path: Path) -> StatedFrame:
    """The frame camera of an ISD."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: not a file of a frame camera with its orientation ({', '.join(SUFFIXES)})")
    return frame_of(read_json(path, _MAX_BYTES), path)


def is_frame(path: Path) -> bool:
    """Return whether a file states a frame camera; a file that cannot be read does not."""
    if path.suffix.lower() not in SUFFIXES:
        return False
    try:
        isd = read_json(path, _MAX_BYTES)
    except InputError:
        return False
    return isinstance(isd, dict) and isd.get("name_model") == FRAME_MODEL


def frame_of(isd: Any, path: Path) -> StatedFrame:
    """The frame camera of the contents of a file; see `read_frame`."""
    name = isd.get("name_model") if isinstance(isd, dict) else None
    if name != FRAME_MODEL:
        advice = "; state the file as `line`" if isinstance(isd, dict) and "line_scan_rate" in isd else ""
        raise InputError(f"{path}: support data of {name or 'no name_model'}, not of {FRAME_MODEL}{advice}")
    source = Isd(isd, path)
    try:
        if source.has("jitter"):
            raise InputError("its lines were exposed one after the other (jitter); such cameras are not known")
        kind = source.distortion
        if kind is not None and kind not in LENSES:
            raise not_known(kind, list(LENSES))
        c, lens = lens_of(source, kind)
        focal = source.focal_plane().focal
        frame = FrameCamera(_interior(source, c), lens, _pose(source))
        _refuse_away(frame, max(source.radii))
        distortion = kind if lens != NoLens() else None
        return StatedFrame(file=path, frame=frame, radii=source.radii, focal=focal, distortion=distortion)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def _interior(isd: Isd, c: float) -> Interior:
    """From tangents to pixels, with a camera constant in millimetres."""
    plane = isd.focal_plane()
    summing = np.array([isd.summing("line"), isd.summing("sample")])
    # Rows: line and sample. The middle of the first pixel is 0 here; y of tangents is up.
    A = plane.to_detector * (1.0, -1.0) / summing[:, None]
    line, sample = ((plane.axis - plane.first) / summing - 0.5).tolist()
    (a4, a5), (a1, a2) = A.tolist()
    return Interior(c, (0.0, 0.0), Affine2D(a1=a1, a2=a2, a3=sample, a4=a4, a5=a5, a6=line), (isd.samples, isd.lines))


def _pose(isd: Isd) -> Pose:
    """Projection centre and axes in those of the body, at the middle of the exposure."""
    t = np.array([isd.numbers("center_ephemeris_time", ())])
    for name in ("instrument_position", "instrument_pointing", "body_rotation"):
        at = isd.moments(name)
        # A single value holds always; a table only as far as it goes.
        if len(at) > 1 and not at[0] <= t[0] <= at[-1]:
            raise InputError(f"{name} is stated from {at[0]:.3f} to {at[-1]:.3f} s, the image is of {t[0]:.3f} s")
    at = isd.moments("instrument_position")
    positions, speeds = isd.positions()
    inertial = positions if len(at) == 1 else cubic(at, positions, speeds, t)
    body = isd.turns("body_rotation", t)
    center = rotations(body)[0] @ inertial[0]
    return Pose(center, rotations(times(body, conjugate(isd.turns("instrument_pointing", t))))[0] @ FLIP)


def _refuse_away(frame: FrameCamera, radius: float) -> None:
    """Refuse a camera that would see its body if it looked the other way."""
    columns, rows = (np.linspace(-0.5, side - 0.5, 9) for side in frame.size)
    S, d = frame.rays(np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2))
    if not (to_sphere(S, d, radius) > 0).any() and (to_sphere(S, -d, radius) > 0).any():
        raise InputError(
            "the camera looks away from its body: positions and pointing are not in the same axes, or the focal plane "
            "is meant to lie behind the lens, which is not known here"
        )
