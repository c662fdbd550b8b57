"""``.RPB``: assignments, as DigitalGlobe writes them."""

from __future__ import annotations

import re
from pathlib import Path

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.camera.rpc.model import GROUPS, MAX_BYTES, SINGLE, stated
from photoplan.io.files import read_text

FORM = "RPB"
#: How ``.RPB`` calls what others call by the keys.
NAMES = {name: name.split("_")[0].lower() + {"OFF": "Offset", "SCALE": "Scale"}[name.split("_")[1]] for name in SINGLE}
NAMES |= {
    name: name.split("_")[0].lower() + {"NUM": "Num", "DEN": "Den"}[name.split("_")[1]] + "Coef" for name in GROUPS
}


def read(path: Path) -> RationalFunctions:
    """Polynomials of ``lineOffset = 2345;``, ``lineNumCoef = ( 1.0E+00, … );`` and so on."""
    text = read_text(path, MAX_BYTES)
    values: dict[str, str] = {}
    for name, own in NAMES.items():
        found = re.findall(rf"\b{own}\s*=\s*\(?([^;()]*)\)?\s*;", text)
        if len(found) > 1:
            raise InputError(f"{path}: {own} is given twice")
        if found:
            values[name] = found[0].replace(",", " ")
    return stated(values, str(path))
