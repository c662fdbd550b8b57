"""A digital frame camera, as a project describes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import model_validator

from photoplan.cameras.interior import Interior
from photoplan.io.camera.model import CameraEntry, Fiducials, InPixels, Pair, Pixels, Positive
from photoplan.io.files import build


class FrameEntry(CameraEntry):
    """A digital frame camera: by its focal length in pixels, or by camera constant and pixel or sensor size."""

    type: Literal["frame"] = "frame"
    size: tuple[Pixels, Pixels]
    """Width and height in pixels."""
    focal_px: Positive | tuple[Positive, Positive] | None = None
    """Camera constant in pixels; two numbers where pixels are not square (x, y)."""
    camera_constant_mm: Positive | None = None
    pixel_size_um: Positive | tuple[Positive, Positive] | None = None
    sensor_size_mm: tuple[Positive, Positive] | None = None
    principal_point_px: Pair | None = None
    """Column and row of the principal point, (0, 0) the centre of the upper-left pixel; default the image's middle."""
    principal_point_mm: Pair | None = None
    """The same as x0 to the right and y0 upwards from the image's middle, millimetres."""

    comments: ClassVar[Mapping[str, str]] = {
        "type": "digital frame camera",
        "size": "width and height, pixels",
        "focal_px": "camera constant in pixels; [x, y] if they differ",
        "camera_constant_mm": "",
        "pixel_size_um": "",
        "sensor_size_mm": "",
        "principal_point_px": "column, row",
        "principal_point_mm": "x right, y up, from the middle of the image",
    }

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.focal_px is None) == (self.camera_constant_mm is None):
            raise ValueError("give either focal_px or camera_constant_mm")
        sizes = (self.pixel_size_um is not None) + (self.sensor_size_mm is not None)
        if self.camera_constant_mm is not None and sizes != 1:
            raise ValueError("camera_constant_mm needs either pixel_size_um or sensor_size_mm")
        if self.focal_px is not None and sizes:
            raise ValueError("focal_px stands alone: leave out pixel_size_um and sensor_size_mm")
        if self.principal_point_mm is not None and self.focal_px is not None:
            raise ValueError("principal_point_mm goes with camera_constant_mm; with focal_px give principal_point_px")
        if self.principal_point_mm is not None and self.principal_point_px is not None:
            raise ValueError("give either principal_point_px or principal_point_mm")
        if self.camera_constant_mm is None and self.lens.needs == "mm":
            raise ValueError("a radial table and a lens in unit mm need camera_constant_mm instead of focal_px")
        return self

    @property
    def fiducial_system(self) -> None:
        """There is none."""
        return None

    @property
    def pixels(self) -> InPixels:
        """The camera in pixels."""
        w, h = self.size
        middle = (w - 1) / 2, (h - 1) / 2
        if self.camera_constant_mm is None:
            assert self.focal_px is not None
            focal = self.focal_px if isinstance(self.focal_px, tuple) else (self.focal_px, self.focal_px)
            return InPixels(self.size, focal, self.principal_point_px or middle)
        px, py = self._pixel_mm
        x0, y0 = self.principal_point_mm or (0.0, 0.0)
        point = self.principal_point_px or (middle[0] + x0 / px, middle[1] - y0 / py)
        return InPixels(self.size, (self.camera_constant_mm / px, self.camera_constant_mm / py), point)

    @property
    def states_pixels(self) -> bool:
        """Whether the principal point is stated in pixels, or nothing is in millimetres."""
        return self.camera_constant_mm is None or self.principal_point_px is not None

    @property
    def _pixel_mm(self) -> tuple[float, float]:
        """Side lengths of a pixel in millimetres."""
        if self.sensor_size_mm is not None:
            return self.sensor_size_mm[0] / self.size[0], self.sensor_size_mm[1] / self.size[1]
        assert self.pixel_size_um is not None
        pair = self.pixel_size_um if isinstance(self.pixel_size_um, tuple) else (self.pixel_size_um,) * 2
        return pair[0] / 1000, pair[1] / 1000

    def interior_orientation(self, size: tuple[int, int], fiducials: Fiducials | None) -> Interior:
        """Interior orientation, the same for all images; `fiducials` are not used."""
        if not self.states_pixels:
            assert self.camera_constant_mm is not None
            return Interior.metric(size, self.camera_constant_mm, self._pixel_mm, self.principal_point_mm or (0.0, 0.0))
        pixels = self.pixels
        col, row = pixels.point
        return Interior.digital(size, pixels.focal, (col - (size[0] - 1) / 2, row - (size[1] - 1) / 2))

    def check_fiducials(self, fiducials: Fiducials, sized: bool, name: str) -> None:
        """A digital image has no marks."""
        raise ValueError(f'fiducials are given, but camera {name!r} is digital (type = "frame")')


def frame_in_pixels(pixels: InPixels, lens: Mapping[str, Any], where: str) -> CameraEntry:
    """The description of a camera that is known in pixels, with the entries of its lens; `where` begins messages."""
    fx, fy = pixels.focal
    focal = fx if fx == fy else pixels.focal
    values = {"size": pixels.size, "focal_px": focal, "principal_point_px": pixels.point, "lens": dict(lens)}
    return build(FrameEntry, values, where)
