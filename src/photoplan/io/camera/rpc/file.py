"""Rational polynomials from files of any known format, and where they lie beside an image."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.camera.rpc import digitalglobe, dimap, geom, rpb, tags, text
from photoplan.io.camera.rpc.model import MAX_BYTES, StatedRpc
from photoplan.io.files import looks_like, read_head, read_xml

#: Kinds of XML documents.
_DOCUMENTS = (digitalglobe, dimap)


def _document(path: Path) -> StatedRpc:
    root = read_xml(path, MAX_BYTES)
    for kind in _DOCUMENTS:
        if kind.is_it(root):
            return StatedRpc(path, kind.FORM, kind.read(root, path))
    raise InputError(f"{path}: an XML document of <{root.tag}> without rational polynomials")


def _text(path: Path) -> StatedRpc:
    kind = geom if geom.is_it(read_head(path)) or path.suffix.lower() == ".geom" else text
    return StatedRpc(path, kind.FORM, kind.read(path))


def _plain(form: str, read: Callable[[Path], RationalFunctions]) -> Callable[[Path], StatedRpc]:
    return lambda path: StatedRpc(path, form, read(path))


#: Reader of every format, by file suffix.
RPC_FORMATS: dict[str, Callable[[Path], StatedRpc]] = {
    ".txt": _text,
    ".rpc": _text,
    ".rpb": _plain(rpb.FORM, rpb.read),
    ".geom": _text,
    ".xml": _document,
}


def read_rpc(path: Path) -> StatedRpc:
    """Rational polynomials of a file: ``_RPC.TXT``, ``.RPB``, ``.geom``, XML of DIMAP or DigitalGlobe, an
    image's own.
    """
    read = RPC_FORMATS.get(path.suffix.lower())
    if read is not None:
        return read(path)
    found = rpc_in(path)
    if found is None:
        known = ", ".join(RPC_FORMATS)
        raise InputError(
            f"{path}: the image holds no rational polynomials (RPC); give the file that does ({known})"
            f"{looks_like(path)}"
        )
    return found


def rpc_in(image: Path) -> StatedRpc | None:
    """Rational polynomials that an image file holds itself; None: it holds none."""
    functions = tags.read(image)
    return None if functions is None else StatedRpc(image, tags.FORM, functions)


def is_rpc(path: Path) -> bool:
    """Whether a text or XML file speaks of rational polynomials."""
    return path.suffix.lower() in RPC_FORMATS and _MARKS.search(read_head(path)) is not None


_MARKS = re.compile(r"LINE_OFF\s*[:=]|lineOffset\s*=|<LINEOFFSET>|<Global_RFM>|<RPB>|<isd>|line_num_coeff_00")


def rpc_beside(image: Path) -> list[Path]:
    """The files of rational polynomials that belong to an image by their names."""
    stem = image.stem
    product = re.sub(r"^IMG_", "RPC_", re.sub(r"_R1C1$", "", stem))
    names = {f"{stem}_rpc.txt", f"{stem}.rpc", f"{stem}.rpb", f"{stem}.xml", f"{stem}.geom"}
    names |= {f"{product}.xml".casefold()} if product.startswith("RPC_") else set()
    wanted = {name.casefold() for name in names}
    beside = sorted(p for p in image.parent.iterdir() if p.name.casefold() in wanted and p.is_file())
    return [path for path in beside if is_rpc(path)]
