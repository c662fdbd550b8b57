"""Images of line cameras: what a project states of them becomes a camera."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from photoplan.cameras.base import Camera
from photoplan.cameras.line_correction import displaced, map_axes
from photoplan.errors import InputError
from photoplan.io.camera.line.correction import read_line_correction, read_pose_errors
from photoplan.io.camera.line.file import read_line
from photoplan.io.camera.line.model import StatedLine
from photoplan.io.project.line import LineImage
from photoplan.io.project.model import Project
from photoplan.project.ground import Ground, stamp_of
from photoplan.project.image_size import check_size


def line_camera(project: Project, image: LineImage, ground: Ground, size: tuple[int, int]) -> Camera:
    """Camera of an image of lines, over the ground as it is worked in."""
    file = project.resolve(image.line)
    stamps = tuple(stamp_of(each) for each in image.geometry_files(project.resolve))
    stated = _read(file, stamps, image.detectors)
    for given, where in ((stated.size, image.line), (image.size, "the project")):
        check_size(image.file, size, given, f"{where} states", "a line camera fits an image of full size only")
    camera = stated.camera(project.crs, ground.working_system)
    if image.correction is None:
        return camera
    correction = read_line_correction(project.resolve(image.correction))
    track = correction.track(camera.track)
    if not image.change:
        return camera.along(track)
    errors = read_pose_errors(project.resolve(image.correction))
    if errors is None:
        raise InputError(
            f"image {image.name!r}: {image.correction} says nothing of the accuracy of the trajectory; `photoplan "
            "adjust` writes it, as [accuracy]"
        )
    return camera.along(displaced(track, errors.course(np.array(image.change)), map_axes(track))).calm()


@lru_cache(maxsize=64)
def _read(file: Path, stamps: tuple[tuple[int, int], ...], detectors: str | None) -> StatedLine:
    """Read again only when one of the files changes."""
    return read_line(file, detectors)
