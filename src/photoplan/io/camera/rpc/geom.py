"""``.geom``: keyword lists of OSSIM and of Orfeo ToolBox before version 8, of sensors with rational polynomials.

Samples and lines are counted from 0 at the centre of the first pixel. ``polynomial_format`` A and B are the orders of
terms of RPC00A and RPC00B (NIMA, STDI-0002, section 8.2).
"""

from __future__ import annotations

import re
from pathlib import Path

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.camera.rpc.model import GROUPS, MAX_BYTES, SINGLE, stated
from photoplan.io.files import read_text

FORM = "OSSIM keyword list (.geom)"
#: Place in RPC00A of every term of RPC00B.
_FROM_A = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)


def is_it(head: str) -> bool:
    """Whether the beginning of a text is of this kind."""
    return re.search(r"^\s*(?:[\w.]+\.)?(?:line_num_coeff_00|polynomial_format)\s*:", head, re.MULTILINE) is not None


def read(path: Path) -> RationalFunctions:
    """Polynomials of ``line_off:  2345``, ``line_num_coeff_00: …`` and so on; keys may have a prefix with dots."""
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
    values: dict[str, str | list[str]] = {name: found[name.lower()] for name in SINGLE if name.lower() in found}
    for group in GROUPS:
        keys = [f"{group.lower()}_{k:02d}" for k in range(20)]
        terms = [found[key] for key in keys if key in found]
        if form == "A" and len(terms) == 20:
            terms = [terms[k] for k in _FROM_A]
        values[group] = terms
    return stated(values, str(path))
