"""``_RPC.TXT``: a line for each number, as GeoEye and GDAL write them."""

from __future__ import annotations

import re
from pathlib import Path

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.camera.rpc.model import GROUPS, MAX_BYTES, SINGLE, stated
from photoplan.io.files import read_text

FORM = "text (_RPC.TXT)"


def rpc_text(functions: RationalFunctions) -> str:
    """The file's text; numbers are written so that reading gives the same again."""
    f = functions
    lines = ["ERR_BIAS: -1", "ERR_RAND: -1"]
    offsets, scales = (*f.image_offset, *f.ground_offset), (*f.image_scale, *f.ground_scale)
    lines += [f"{name}: {value!r}" for name, value in zip(SINGLE, (*offsets, *scales))]
    for name, row in zip(GROUPS, f.coefficients.tolist()):
        lines += [f"{name}_{k}: {value!r}" for k, value in enumerate(row, 1)]
    return "\n".join(lines) + "\n"


def read(path: Path) -> RationalFunctions:
    """Polynomials of ``LINE_OFF: +002345.00 pixels``, ``LINE_NUM_COEFF_1: …`` and so on; what else there is,
    is left.
    """
    found: dict[str, str] = {}
    for number, line in enumerate(read_text(path, MAX_BYTES).split("\n"), 1):
        match = re.match(r"\s*([A-Z_]+(?:_\d+)?)\s*[:=]\s*(\S+)", line)
        if match is None:
            continue
        if match[1] in found:
            raise InputError(f"{path}:{number}: {match[1]} is given twice")
        found[match[1]] = match[2]
    values: dict[str, str | list[str]] = {name: found[name] for name in SINGLE if name in found}
    for group in GROUPS:
        terms = [found[f"{group}_{k}"] for k in range(1, 21) if f"{group}_{k}" in found]
        if terms:
            values[group] = terms
    return stated(values, str(path))
