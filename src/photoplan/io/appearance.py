"""What a refused file looks like: named in the refusal, so that the right option or converter is found."""

from __future__ import annotations

import re
import struct
from pathlib import Path

_LOOK = 4096
#: First bytes, and what begins with them.
_MAGIC = {
    b"PK\x03\x04": "a ZIP archive; unpack it first",
    b"\x1f\x8b": "a gzip archive; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
    b"%PDF": "a PDF document",
    b"SQLite format 3": "a GeoPackage or SQLite database",
    b"LASF": "a LAS or LAZ point cloud",
    b"ply\n": "a PLY mesh or point cloud",
    b"ply\r": "a PLY mesh or point cloud",
    b"\x00\x00\x27\x0a": "a Shapefile",
    b"\x89HDF": "an HDF5 or NetCDF file",
    b"II*\x00": "a TIFF raster",
    b"MM\x00*": "a TIFF raster",
    b"II+\x00": "a BigTIFF raster",
    b"MM\x00+": "a BigTIFF raster",
    b"\xff\xd8\xff": "a JPEG image",
    b"\x89PNG": "a PNG image",
    b"\x00\x00\x00\x0cjP": "a JPEG 2000 image",
    b"NITF": "a NITF image",
    b"EHFA_HEADER": "an ERDAS Imagine raster",
}
#: Patterns of text, and what holds them; the first that is found counts.
_TEXT = (
    (r'"type"\s*:\s*"(FeatureCollection|Feature|GeometryCollection)"', "GeoJSON"),
    (r'"(?:cmap|crs|ids)"\s*:.*"(?:PROJJSON|projjson)"', "PROJJSON"),
    (r"LINE_OFF\s*[:=]|LINE_NUM_COEFF_1|lineOffset\s*=|<LINE_OFF>|<RFM_Validity", "rational polynomials (RPC)"),
    (r"<LandXML\b", "LandXML"),
    (r"<kml\b", "KML"),
    (r"<gpx\b", "GPX"),
    (r"<VRTDataset\b", "a virtual raster of GDAL"),
    (r"<html\b|<!doctype html", "a web page, perhaps of a download that failed"),
    (r"\A\s*0\s+SECTION\b", "a DXF drawing"),
    (r"\A# Bundle file v", "Bundler's bundle.out; import it into COLMAP or OpenSfM and give that model"),
    (r"\ANVM_V\d", "VisualSFM's NVM; import it into COLMAP and give that model"),
    (r"\A\s*(?:GEOGCS|PROJCS|GEOGCRS|PROJCRS|COMPD_CS)\s*\[", "a CRS as WKT"),
)
_COLMAP = ("cameras.bin", "images.bin", "points3D.bin")


def looks_like(path: Path) -> str:
    """``"; it looks like …"`` for the end of a refusal, or nothing where the file shows no kind that is known.

    Only the first bytes are looked at; a file that cannot be read shows nothing.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_LOOK)
    except OSError:
        return ""
    kind = _kind(path, head)
    return f"; it looks like {kind}" if kind else ""


def _kind(path: Path, head: bytes) -> str | None:
    for magic, name in _MAGIC.items():
        if head.startswith(magic):
            return name
    if path.suffix.lower() == ".bin" and len(head) >= 8 and struct.unpack_from("<Q", head)[0] < 1 << 32:
        known = path.name if path.name in _COLMAP else "a model"
        return f"{known} of COLMAP in binary; give its folder as orientation"
    text = head.decode("utf-8", "replace").lstrip("\ufeff")
    for pattern, name in _TEXT:
        if re.search(pattern, text, re.IGNORECASE):
            return name
    element = re.search(r"<([A-Za-z_][\w.:-]*)", text) if text.lstrip().startswith("<") else None
    if element:
        return f"an XML document of <{element[1]}>"
    return "JSON" if re.match(r'\s*(\{\s*"|\[\s*[\[{"\d])', text) else None
