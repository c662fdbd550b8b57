"""Orientations against the positions that image files state (EXIF, XMP)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photoplan.errors import InputError
from photoplan.geometry.agreement import agreement
from photoplan.io.image_metadata import read_image_metadata
from photoplan.io.orientation.exif import SUFFIXES, map_positions
from photoplan.io.project.model import Image, Project

#: No receiver is off by so much, metres.
_FAR = 1000.0
#: A turn of the block against its positions that is told: degrees, and in its own standard deviations.
_TURN, _CLEAR = 0.2, 6.0


def _position(project: Project, image: Image) -> list[float]:
    """Map coordinates and height that an image file states, NaN where it does not."""
    path = Path(project.resolve(image.file))
    nothing = [float("nan")] * 3
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return nothing
    try:
        stated = read_image_metadata(path)
        if (
            stated.position is None
            or (stated.datum or "WGS84").upper().replace("-", "").replace(" ", "")[:5] != "WGS84"
        ):
            return nothing
        return [float(v) for v in map_positions([stated], project.crs)[0]]
    except InputError:
        return nothing


def position_fault(project: Project, image: Image) -> str | None:
    """Why an orientation cannot be that of the image file; None if it can, or the file states no position."""
    if image.center is None:
        return None
    away = float(np.hypot(*(np.array(_position(project, image)[:2]) - image.center[:2])))
    if not away > _FAR:
        return None
    return f"its file states a GPS position {away / 1000:.3g} km away; is the CRS right, and the image the one meant?"


def turned_against_positions(project: Project, names: Sequence[str]) -> tuple[str, ...]:
    """A sentence where the block is turned against the positions of its files."""
    images = [image for image in map(project.image, names) if image.center is not None]
    if len(images) < 4:
        return ()
    found = agreement([_position(project, image) for image in images], [image.center or () for image in images])
    turn, sigma = np.degrees([found.turn, found.sigma_turn])
    if not (abs(turn) > max(_TURN, _CLEAR * sigma) and found.count >= 4):
        return ()
    return (
        f"the projection centres are turned by {turn:.2f}° ± {sigma:.2f}° against the GPS positions of {found.count} "
        "image files: grid north, or the axes of another CRS?",
    )
