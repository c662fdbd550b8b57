"""Units of length: feet, metres, fathoms and every other unit of PROJ, GDAL, GeoTIFF, LAS, LandXML and DXF.

All computations use metres and heights that count upwards. Readers bring the numbers of a file there by the factors
of this module: `metres_in` for a unit by its name or its EPSG code, `metric_system` for the units of a CRS. A unit
that is not known, and two statements that contradict each other, are errors.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.database import get_units_map
from pyproj.exceptions import CRSError

from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.crs import canonical_crs, parse_crs

FOOT, US_FOOT = 0.3048, 1200.0 / 3937.0
_BRITISH_FOOT, _INDIAN_FOOT = 0.30479947153867626, 0.3047995102481469

#: Metres in a unit, by its names in small letters. EPSG's names and codes are added by `_known`.
_NAMES: dict[float, str] = {
    1.0: "m metre metres meter meters mètre mètres metro metros mtr mtrs",
    1e3: "km kilometre kilometres kilometer kilometers",
    1e2: "hm hectometre hectometres hectometer hectometers",
    1e1: "dam decametre decametres decameter decameters dekametre dekameter",
    1e-1: "dm decimetre decimetres decimeter decimeters",
    1e-2: "cm centimetre centimetres centimeter centimeters",
    1e-3: "mm millimetre millimetres millimeter millimeters",
    1e-6: "um µm μm micron microns micrometre micrometres micrometer micrometers",
    1e-9: "nanometre nanometres nanometer nanometers",
    0.0254: "in inch inches inch-i in-i ''",
    FOOT: "ft foot feet ' ft-i foot-i ft-intl foot-intl intl-ft intl-foot intl-feet international-foot "
    "international-feet feet-intl ift",
    0.9144: "yd yard yards yd-i international-yard yd-intl",
    1609.344: "mi mile miles mi-i statute-mile statute-miles international-mile mi-intl",
    1852.0: "kmi nmi nmi-i nautical-mile nautical-miles international-nautical-mile",
    1.8288: "fath fathom fathoms fth fth-i international-fathom",
    20.1168: "ch chain chains international-chain",
    0.201168: "link links international-link",
    US_FOOT: "us-ft us-foot us-feet usft ftus ft-us foot-us feet-us us-survey-foot us-survey-feet survey-foot "
    "survey-feet ussurveyfoot ussurveyfeet u-s-survey-foot u-s-survey-feet sft ussft",
    US_FOOT / 12: "us-in in-us us-inch us-survey-inch us-survey-inches",
    US_FOOT * 3: "us-yd yd-us us-yard us-survey-yard us-survey-yards",
    US_FOOT * 5280: "us-mi mi-us us-mile us-survey-mile us-survey-miles",
    US_FOOT * 66: "us-ch ch-us us-chain us-survey-chain us-survey-chains",
    US_FOOT * 0.66: "us-link lk-us us-survey-link us-survey-links",
    US_FOOT * 16.5: "rd-us us-survey-rod us-rod",
    US_FOOT * 6: "fth-us us-fathom us-survey-fathom",
    _BRITISH_FOOT: "foot-sears sears-foot ft-br",
    _BRITISH_FOOT * 3: "yard-sears sears-yard yd-br",
    _BRITISH_FOOT * 66: "chain-sears sears-chain ch-br",
    _BRITISH_FOOT * 0.66: "link-sears sears-link lk-br",
    0.30479841: "ind-ft",
    0.91439523: "ind-yd",
    20.11669506: "ind-ch indian-chain",
    _INDIAN_FOOT: "foot-indian",
    1.0000135965: "german-metre german-meter legal-metre",
}
#: Names that PROJ's register writes with values of its own (its decimetre is a centimetre) or that mean no one unit.
_NOT_TAKEN = ("decimeter", "indian-chain")
#: Metres in the unit of a drawing by its number in $INSUNITS (DXF reference, HEADER section); 0 states none.
DRAWING_UNITS: dict[int, tuple[str, float]] = {
    1: ("inches", 0.0254),
    2: ("feet", FOOT),
    3: ("miles", 1609.344),
    4: ("millimetres", 1e-3),
    5: ("centimetres", 1e-2),
    6: ("metres", 1.0),
    7: ("kilometres", 1e3),
    8: ("microinches", 0.0254e-6),
    9: ("mils", 0.0254e-3),
    10: ("yards", 0.9144),
    11: ("angstroms", 1e-10),
    12: ("nanometres", 1e-9),
    13: ("microns", 1e-6),
    14: ("decimetres", 0.1),
    15: ("decametres", 10.0),
    16: ("hectometres", 100.0),
    17: ("gigametres", 1e9),
    18: ("astronomical units", 149597870700.0),
    19: ("light years", 9460730472580800.0),
    20: ("parsecs", 3.0856775814913674e16),
    21: ("US survey feet", US_FOOT),
    22: ("US survey inches", US_FOOT / 12),
    23: ("US survey yards", US_FOOT * 3),
    24: ("US survey miles", US_FOOT * 5280),
}
#: Units of one name that differ by less: international and US survey foot do by 2 parts in a million.
_ONE_NAME = 1e-5
#: Units that differ by more are different ones.
_SAME = 1e-9
_ACCEPTED = "m, dm, cm, mm, km, ft, US survey foot, yd, in, mi, nautical mile, fathom, or another name or code of EPSG"


def _plain(name: str) -> str:
    """A unit's name in small letters, with one hyphen between its words."""
    text = re.sub(r"['’]s(?![a-z])", "", name.strip().casefold()).replace("[", "").replace("]", "")
    return re.sub(r"^u-s-(?!survey)", "us-", re.sub(r"[\s_.\-/()]+", "-", text).strip("-")) or text


@lru_cache(maxsize=1)
def _known() -> tuple[dict[str, float], dict[int, float]]:
    """Metres in a unit by its plain name, and by its EPSG code."""
    by_name: dict[str, float] = {}
    by_code: dict[int, float] = {}
    for name, unit in get_units_map(category="linear").items():
        plain = _plain(name)
        if unit.auth_name == "EPSG" and str(unit.code).isdigit():
            by_code[int(unit.code)] = US_FOOT if name == "US survey foot" else float(unit.conv_factor)
        if plain not in _NOT_TAKEN:
            by_name[plain] = float(unit.conv_factor)
            # Esri writes the kind of unit first: Foot_Clarke, Yard_Indian.
            words = plain.split("-")
            by_name.setdefault("-".join([words[-1], *words[:-1]]), float(unit.conv_factor))
    for metres, names in _NAMES.items():
        by_name |= dict.fromkeys(names.split(), metres)
    return by_name, by_code


def known_metres(unit: str | int) -> float | None:
    """Metres in a unit of length by its name in any usual spelling, or a multiple, or its EPSG code; None: unknown."""
    by_name, by_code = _known()
    if isinstance(unit, int):
        return by_code.get(unit)
    text = unit.strip()
    code = re.fullmatch(r"(?:EPSG:{1,2})?(\d{4,5})", text, re.I)
    if code:
        return by_code.get(int(code[1]))
    # Capital letters decide in SI: Mm are megametres.
    if text in ("Mm", "Gm", "Tm", "Pm"):
        return None
    multiple = re.fullmatch(r"(\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)\s*\*?\s*([^\d\s].*)", text)
    if multiple and float(multiple[1]) > 0:
        found = by_name.get(_plain(multiple[2]))
        return None if found is None else float(multiple[1]) * found
    return by_name.get(_plain(text))


def metres_in(unit: str | int, where: str) -> float:
    """Metres in a unit of length."""
    found = known_metres(unit)
    if found is None:
        raise InputError(f"{where}: {str(unit)[:60]!r} is not a known unit of length; known are {_ACCEPTED}")
    return found


def unit_label(metres: float | None) -> str:
    """Name of the unit that has so many metres; depths are told apart from heights."""
    if metres is None:
        return "a unit that is not stated"
    depth = " downwards" if metres < 0 else ""
    names = {1.0: "metres", FOOT: "feet", US_FOOT: "US survey feet"}
    names |= {size: name for name, size in DRAWING_UNITS.values()}
    size = abs(metres)
    found = next((name for value, name in names.items() if abs(value - size) <= _SAME * value), None)
    return (found or f"units of {size:.12g} m") + depth


def agreed_metres(stated: float | None, system: float | None, where: str, *, in_one_file: bool) -> float:
    """Metres in the unit of coordinates of which the file states a unit and a reference system states one, too."""
    if system is None and stated is None:
        raise HeightSystemError(
            f"{where}: the unit of heights is not stated, and X and Y are not in metres; declare a height system with "
            "its unit: EPSG:5703 is NAVD88 in metres, EPSG:6360 in US survey feet"
        )
    if system is None or stated is None:
        return float(stated if system is None else system)  # type: ignore[arg-type]
    size = abs(system)
    if abs(stated - size) <= _ONE_NAME * size:
        return system  # "feet" of a file are those of its reference system
    if size == 1.0 and not in_one_file:
        return stated * system
    raise InputError(
        f"{where}: the file states {unit_label(stated)}, the reference system {unit_label(system)}; correct the one "
        "that is wrong (of rasters by `gdal_edit.py -units` or `-a_srs`), or declare another reference system"
    )


@dataclass(frozen=True)
class MetricSystem:
    """A reference system in metres, and the factors that lead the numbers of a file there."""

    crs: str
    """Horizontal CRS in metres, or in degrees if it is geographic."""
    scale: float
    """Metres in a unit of X and Y; 1 for degrees."""
    heights: str | None
    """Height system in metres upwards; None: not stated."""
    height_scale: float | None
    """Metres upwards in a unit of Z, negative for depths; None: X and Y are not in metres and nothing is said of Z."""

    @property
    def is_plain(self) -> bool:
        """Return whether numbers are metres upwards already."""
        return self.scale == 1.0 and self.height_scale == 1.0

    def declaring(self, heights: str | None, where: str = "declared height system") -> MetricSystem:
        """The system with a declared height system instead of its own, in metres; None and `same` declare none.

        `ellipsoidal` is a word and has no unit: heights stay in the unit that is stated.
        """
        word = "same" if heights is None else heights.strip().casefold()
        if word == "same":
            return self
        metric, rise = metric_heights(word if heights is None else heights, where)
        if word == "ellipsoidal":
            return replace(self, heights=metric)
        return replace(self, heights=metric, height_scale=rise)

    def to_metres(self, XYZ: NDArray[np.float64], where: str) -> NDArray[np.float64]:
        """Coordinates (..., 3) in metres; NaN stays NaN."""
        if self.is_plain:
            return XYZ
        rise = self.height_scale
        if rise is None:
            rise = agreed_metres(None, None, where, in_one_file=True) if np.isfinite(XYZ[..., 2]).any() else 1.0
        return np.asarray(XYZ * np.array([self.scale, self.scale, rise]), np.float64)


@lru_cache(maxsize=256)
def metric_system(text: str, where: str = "CRS") -> MetricSystem:
    """The reference system of a text (EPSG code, WKT, PROJJSON or PROJ string) in metres."""
    crs = parse_crs(text, where)
    if crs.type_name == "Engineering CRS":
        units = " and ".join(dict.fromkeys(axis.unit_name for axis in crs.axis_info[:2]))
        raise InputError(
            f"{where}: {crs.name!r} is a local system in {units}; a projected or geographic CRS is needed, or a local "
            "system in metres: convert the coordinates, or state the CRS in which they are"
        )
    heights, rise = None, None
    horizontal = crs
    if crs.is_compound:
        horizontal = crs.sub_crs_list[0]
        heights, rise = metric_heights(crs.sub_crs_list[1].to_wkt(), where)
    elif len(crs.axis_info) == 3 and not crs.is_geocentric:
        horizontal = crs.to_2d()
        heights, rise = "ellipsoidal", _upwards(crs)
    scale = 1.0
    name = canonical_crs(text) if horizontal is crs else canonical_crs(horizontal.to_wkt())
    if horizontal.is_projected:
        factors = {axis.unit_conversion_factor for axis in horizontal.axis_info[:2]}
        if len(factors) != 1 or not 0 < min(factors) < np.inf:
            raise InputError(f"{where}: {crs.name!r} has axes in different units; a CRS with one unit is needed")
        scale = _exact(factors.pop())
        if scale != 1.0:
            name = _in_metres(horizontal)
    return MetricSystem(name, scale, heights, rise if rise is not None else 1.0 if scale == 1.0 else None)


@lru_cache(maxsize=256)
def metric_heights(name: str, where: str = "height system") -> tuple[str, float]:
    """Height system in metres upwards, and the metres upwards in a unit of the given one (negative for depths)."""
    word = name.strip().casefold()
    if word in ("ellipsoidal", "same"):
        return word, 1.0
    crs = parse_crs(name, where)
    if crs.is_compound:
        crs = crs.sub_crs_list[1]
    if crs.is_vertical:
        rise = _upwards(crs)
        return (canonical_crs(crs.to_wkt()) if rise == 1.0 else _in_metres(crs)), rise
    if len(crs.axis_info) == 3 and not crs.is_geocentric:
        return "ellipsoidal", _upwards(crs)
    raise InputError(f"{where}: {crs.name!r} says nothing of heights")


def _exact(factor: float) -> float:
    """A factor as it is defined, where it was printed with fewer digits."""
    return next((exact for exact in (1.0, FOOT, US_FOOT) if abs(factor - exact) <= _SAME * exact), factor)


def _upwards(crs: CRS) -> float:
    """Metres upwards in a unit of the last axis."""
    axis = crs.axis_info[-1]
    factor = _exact(float(axis.unit_conversion_factor))
    return -factor if axis.direction.casefold() == "down" else factor


def _in_metres(crs: CRS) -> str:
    """The CRS with axes in metres, vertical ones upwards; EPSG's own if it has one."""
    content: dict[str, Any] = crs.to_json_dict()
    inner = content
    while "coordinate_system" not in inner:
        inner = inner["source_crs"] if "source_crs" in inner else inner["base_crs"]
    for each in (content, inner):
        for key in ("id", "ids", "scope", "area", "bbox", "usages", "remarks"):
            each.pop(key, None)
    inner["coordinate_system"].pop("id", None)
    for axis in inner["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
        if axis["direction"] == "down":
            axis |= {"direction": "up", "name": "Gravity-related height", "abbreviation": "H"}
    # EPSG writes the unit, and the direction, into the name: "NAVD88 height (ftUS)", "MSL depth".
    name = re.sub(r"\s*\((?:[^()]*(?:ft|foot|feet|yd|ch|link|fath|Br36|m)[^()]*(?:\([^()]*\))?[^()]*)\)$", "", crs.name)
    if crs.is_vertical:
        name = re.sub(r"\bdepth\b", "height", name)
    if inner is content:
        inner["name"] = name
    metric = CRS.from_json_dict(content)
    for registered in (name, f"{name} (m)", f"{name} (metre)"):
        try:
            found = CRS.from_user_input(registered)
        except CRSError:
            continue
        same_datum = (
            not crs.is_vertical
            or found.to_json_dict().get("datum", 0) == crs.to_json_dict().get("datum", 1)
            or found.to_json_dict().get("datum_ensemble", 0) == crs.to_json_dict().get("datum_ensemble", 1)
        )
        if found.to_epsg() and same_datum and found.equals(metric, ignore_axis_order=True):
            return f"EPSG:{found.to_epsg()}"
    return canonical_crs(metric.to_wkt())
