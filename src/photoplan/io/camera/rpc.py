"""Rational polynomials (RPC00B) of satellite images, from the files that they are delivered in.

Every format is a way to the texts of ten offsets and scales and of 80 coefficients, by the names that GDAL uses.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import rasterio

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.files import looks_like, read_head, read_text, read_xml
from photoplan.io.gdal import gdal_settings, not_georeferenced
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
        return RationalFunctions((x - first, y - first), (xs, ys), (lon, lat, h), (dlon, dlat, dh), coefficients)
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
            f"{looks_like(path)}"
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
