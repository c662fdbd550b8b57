"""Files of rational polynomials, as others write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio

from photoplan.cameras.rpc import RationalFunctions
from tools.rpc_images import gdal_form

GROUPS = ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF")


def tagged(path: Path, rpc: RationalFunctions, pixels: np.ndarray) -> Path:
    """A TIFF that holds them as a tag; pixels (bands, rows, columns)."""
    bands, height, width = pixels.shape
    with rasterio.open(path, "w", driver="GTiff", width=width, height=height, count=bands, dtype=pixels.dtype) as file:
        file.write(pixels)
        file.update_tags(ns="RPC", **gdal_form(rpc))
    return path


def as_text(rpc: RationalFunctions) -> str:
    """``_RPC.TXT``."""
    lines = []
    for name, value in gdal_form(rpc).items():
        if name in GROUPS:
            lines += [f"{name}_{k}: {word}" for k, word in enumerate(value.split(), 1)]
        else:
            lines.append(f"{name}: {value} units")
    return "\r\n".join(lines) + "\r\n"


def as_rpb(rpc: RationalFunctions) -> str:
    """``.RPB``."""
    f = gdal_form(rpc)
    parts = ['satId = "QB02";\nSpecId = "RPC00B";\nBEGIN_GROUP = IMAGE\n\terrBias = 1.0;\n\terrRand = 0.5;']
    for axis in ("line", "samp", "lat", "long", "height"):
        parts.append(f"\t{axis}Offset = {f[f'{axis.upper()}_OFF']};\n\t{axis}Scale = {f[f'{axis.upper()}_SCALE']};")
    for name in GROUPS:
        axis, what, _ = name.split("_")
        parts.append(f"\t{axis.lower()}{what.title()}Coef = (\n\t\t\t" + ",\n\t\t\t".join(f[name].split()) + ");")
    return "\n".join([*parts, "END_GROUP = IMAGE\nEND;\n"])


def as_digitalglobe(rpc: RationalFunctions) -> str:
    """``.XML`` with an element RPB."""
    f = gdal_form(rpc)
    image = ""
    for axis in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT"):
        image += f"<{axis}OFFSET>{f[f'{axis}_OFF']}</{axis}OFFSET><{axis}SCALE>{f[f'{axis}_SCALE']}</{axis}SCALE>"
    for name in GROUPS:
        own = name.replace("_", "")[:-1]
        image += f"<{own}List><{own}>{f[name]}</{own}></{own}List>"
    return f"<?xml version='1.0' encoding='UTF-8'?><isd><RPB><SPECID>RPC00B</SPECID><IMAGE>{image}</IMAGE></RPB></isd>"


def as_dimap(rpc: RationalFunctions, first: int = 1) -> str:
    """``RPC_*.XML`` of Pléiades and SPOT: rows and columns begin with `first`."""
    f = gdal_form(rpc)
    terms = "".join(f"<{g}_{k}>{w}</{g}_{k}>" for g in GROUPS for k, w in enumerate(f[g].split(), 1))
    domain = f"<Direct_Model_Validity_Domain><FIRST_ROW>{first}</FIRST_ROW><FIRST_COL>{first}</FIRST_COL>"
    domain += "</Direct_Model_Validity_Domain>"
    for axis in ("LINE", "SAMP", "LAT", "LONG", "HEIGHT"):
        offset = float(f[f"{axis}_OFF"]) + first * (axis in ("LINE", "SAMP"))
        domain += f"<{axis}_SCALE>{f[f'{axis}_SCALE']}</{axis}_SCALE><{axis}_OFF>{offset!r}</{axis}_OFF>"
    return (
        "<?xml version='1.0' encoding='UTF-8'?><Dimap_Document><Rational_Function_Model><Global_RFM><Direct_Model/>"
        f"<Inverse_Model>{terms}</Inverse_Model><RFM_Validity>{domain}</RFM_Validity></Global_RFM>"
        "</Rational_Function_Model></Dimap_Document>"
    )
