"""Images that bring their geometry along: it stands in the image file, or in a file beside it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from photoplan.io.camera.rpc.file import read_rpc, rpc_beside, rpc_in
from photoplan.io.names import match_key, relative_path
from photoplan.io.project.rpc import TAGS, RpcImage


@dataclass(frozen=True)
class OwnGeometry:
    """An image with rational polynomials."""

    image: RpcImage
    place: tuple[float, float]
    """Latitude and longitude in the middle of what the polynomials hold for, degrees."""


def own_geometry(files: Iterable[Path], folder: Path) -> dict[Path, OwnGeometry]:
    """Those of the files that have rational polynomials; tags come before a file beside the image.

    Raises
    ------
    InputError
        Polynomials that there are cannot be used.
    """
    found = {}
    for file in files:
        rpc, beside = rpc_in(file), None
        if rpc is None and (beside := rpc_beside(file)) is not None:
            rpc = read_rpc(beside)
        if rpc is not None:
            source = TAGS if beside is None else relative_path(beside, folder)
            lon, lat, _ = rpc.functions.ground_offset
            image = RpcImage(name=match_key(file.name), file=relative_path(file, folder), rpc=source)
            found[file] = OwnGeometry(image, (lat, lon))
    return found
