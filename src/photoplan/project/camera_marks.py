"""What a film camera's fiducial marks look like: from its description to the patterns that are sought."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from photoplan.cameras.mark_pattern import MarkExample, MarkPattern
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io import mark_model as described
from photoplan.io.camera.model import FilmCamera
from photoplan.io.names import resolve_input
from photoplan.orientation.marks import catalogue as free
from photoplan.orientation.marks import silhouettes as frame
from photoplan.project.scan_image import ScanImage

_LARGEST = 4096
"""Side of an example in pixels beyond which it must be a whole scan."""


def mark_patterns(camera: FilmCamera, folder: Path) -> dict[str, MarkPattern | MarkExample]:
    """What each of a camera's fiducial marks looks like, by name.

    Parameters
    ----------
    camera : FilmCamera
        Description of the camera.
    folder : Path
        Where relative names of examples start.

    Raises
    ------
    InputError
        Nothing is described, a mark is not, or a description is not possible; the mark is named.
    """
    marks = camera.marks
    if marks is None:
        raise InputError(
            "what the camera's fiducial marks look like is not described; add `marks`, such as "
            '`marks = { type = "cross", arm = 1.0, width = 0.1 }`'
        )
    names = list(camera.fiducials_mm)
    if not isinstance(marks, described.EachMark):
        one = mark_pattern(marks, folder)
        return dict.fromkeys(names, one)
    each = marks.__pydantic_extra__
    made = {}
    for name in names:
        try:
            made[name] = mark_pattern(each[name], folder)
        except InputError as error:
            raise type(error)(f"fiducial mark {name!r}: {error}") from None
    return made


def mark_pattern(mark: described.Mark, folder: Path) -> MarkPattern | MarkExample:
    """What one mark looks like.

    Parameters
    ----------
    mark : Mark
        Its description.
    folder : Path
        Where relative names of examples start.

    Raises
    ------
    InputError
        The numbers do not make a mark, or the example cannot be read.
    """
    if isinstance(mark, described.Example):
        return _example(mark, folder)
    if isinstance(mark, described.Polygon):
        return _polygon(mark)
    given = mark.model_dump(exclude_none=True)
    kind = given.pop("type")
    if isinstance(mark, described.Silhouette):
        style = frame.Style(**{key: given.pop(key) for key in described.Silhouette.model_fields if key in given})
        makers = {
            "block": frame.block,
            "curve": frame.curve,
            "notch": frame.notch,
            "triangle": frame.triangle,
            "arc": frame.arc,
        }
        made: MarkPattern = makers[kind](**given, style=style)  # type: ignore[operator]
        return made
    drawn = {
        "cross": free.cross,
        "dot": free.dot,
        "ring": free.ring,
        "ring_cross": free.ring_cross,
        "dot_cross": free.dot_cross,
    }
    pattern: MarkPattern = drawn[kind](**given)  # type: ignore[operator]
    return pattern


def _polygon(mark: described.Polygon) -> MarkPattern:
    parts = [(np.array(part.outline, np.float64), math.nan if part.tone is None else part.tone) for part in mark.parts]
    ground = math.nan if mark.background is None else mark.background
    return free.polygon(parts, background=ground, window=mark.window, rotation=mark.rotation)


def _example(mark: described.Example, folder: Path) -> MarkExample:
    path = resolve_input(folder, mark.file)
    scan = ScanImage(path)
    width, height = scan.size
    if max(width, height) > _LARGEST:
        raise InputError(
            f"{path}: {width} × {height} px; an example holds the mark alone, up to {_LARGEST} px. Cut it out"
        )
    x, y = mark.reference
    if not (-width <= x <= 2 * width and -height <= y <= 2 * height):
        raise InputError(f"{path}: reference [{x}, {y}] is far outside of its {width} × {height} px")
    values = scan.grey(Window(0, 0, width, height))
    if mark.mirrored:
        values, x = values[:, ::-1], width - 1 - x
    for _ in range(mark.rotation // 90):
        # Anticlockwise: the right column becomes the upper row.
        x, y, values = y, values.shape[1] - 1 - x, np.rot90(values)
    return MarkExample(path.name, np.ascontiguousarray(values), (float(x), float(y)), mark.pixel_um / 1000)
