"""Images of frame cameras that a file orients: what a project states of them becomes a camera."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from photoplan.cameras.base import Camera
from photoplan.io.camera.csm_frame import StatedFrame, read_frame
from photoplan.io.project.frame import FrameImage
from photoplan.io.project.model import Project
from photoplan.project.ground import Ground, stamp_of
from photoplan.project.image_size import check_size


def frame_camera(project: Project, image: FrameImage, ground: Ground, size: tuple[int, int]) -> Camera:
    """Camera of an image, over the ground as it is worked in."""
    file = project.resolve(image.frame)
    stated = _read(file, stamp_of(file))
    for given, where in ((stated.size, image.frame), (image.size, "the project")):
        check_size(image.file, size, given, f"{where} states", "its camera fits an image of full size only")
    return stated.camera(project.crs, ground.working_system)


@lru_cache(maxsize=64)
def _read(file: Path, stamp: tuple[int, int]) -> StatedFrame:
    """Read again only when the file changes."""
    return read_frame(file)
