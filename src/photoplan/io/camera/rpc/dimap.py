"""DIMAP: ``RPC_*.XML`` of Pléiades, Pléiades Neo and SPOT 6/7, and the document of a Pléiades system product.

All but Pléiades Neo count rows and columns from 1: the centre of the upper-left pixel is (1, 1), as the validity domain
of the model from the image to the ground says. That from the ground to the image is called inverse (Pléiades Imagery
User Guide, section 5.2.3); Pléiades Neo (DIMAP 3) calls both by what they do.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.camera.rpc.model import GROUPS, SINGLE, stated

FORM = "DIMAP (XML)"
#: How a system product calls the axes; A is the scale, B the offset.
_AXES = {"SAMP": "Col", "LINE": "Row", "LONG": "Lon", "LAT": "Lat", "HEIGHT": "Alt"}


def is_it(root: Element) -> bool:
    """Whether a document is of this kind."""
    return root.find(".//Global_RFM") is not None


def read(root: Element, path: Path) -> RationalFunctions:
    """Polynomials of the inverse model."""
    model = root.find(".//Global_RFM")
    assert model is not None
    validity = model.find("RFM_Validity")
    inverse = _first(model, "Inverse_Model", "GroundtoImage_Values")
    if inverse is None or validity is None:
        missing = "no Inverse_Model (or GroundtoImage_Values) or no RFM_Validity in Global_RFM"
        raise InputError(f"{path}: {missing}; get a fresh copy")
    values = _system(inverse, validity) if inverse.find("F_COL") is not None else _delivered(inverse, validity)
    domain = _first(validity, "Direct_Model_Validity_Domain", "ImagetoGround_Validity_Domain")
    begins = [None if domain is None else domain.findtext(name) for name in ("FIRST_COL", "FIRST_ROW")]
    from_zero = all(text is not None and text.strip() in ("0", "0.0") for text in begins)
    return stated(values, str(path), (0.0, 0.0) if from_zero else (1.0, 1.0))


def _first(element: Element, *names: str) -> Element | None:
    """The first of the elements that is there."""
    return next((found for name in names if (found := element.find(name)) is not None), None)


def _delivered(inverse: Element, validity: Element) -> dict[str, str | list[str]]:
    """Numbers of a delivered product, an element for each."""
    values: dict[str, str | list[str]] = {}
    for name in SINGLE:
        text = validity.findtext(name)
        if text is not None:
            values[name] = text
    for group in GROUPS:
        terms = [inverse.findtext(f"{group}_{k}") for k in range(1, 21)]
        if any(term is not None for term in terms):
            values[group] = [term for term in terms if term is not None]
    return values


def _system(inverse: Element, validity: Element) -> dict[str, str | list[str]]:
    """Numbers of a system product: numerator and denominator follow each other in one element."""
    values: dict[str, str | list[str]] = {}
    for name in SINGLE:
        axis, what = name.split("_")
        text = validity.findtext(f"{_AXES[axis]}/{'A' if what == 'SCALE' else 'B'}")
        if text is not None:
            values[name] = text
    for axis, own in (("SAMP", "F_COL"), ("LINE", "F_ROW")):
        words = (inverse.findtext(own) or "").split()
        values |= {f"{axis}_NUM_COEFF": words[:20], f"{axis}_DEN_COEFF": words[20:]}
    return values
