"""A film camera whose photographs were scanned, as a project describes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Strict, field_validator, model_validator

from photoplan.cameras.fiducials import MODELS
from photoplan.cameras.interior import Interior
from photoplan.io.camera.model import CameraEntry, Fiducials, FiducialSystem, Pair, Pixels, Positive
from photoplan.io.mark_model import EachMark, Marks


class FilmEntry(CameraEntry):
    """A film camera whose photographs were scanned; each image states where its fiducial marks are in the scan."""

    type: Literal["film"]
    camera_constant_mm: Positive
    fiducials_mm: Fiducials
    """Calibrated fiducial marks: name = [x, y], x right and y upwards, millimetres."""
    principal_point_mm: Pair = (0.0, 0.0)
    """Principal point of the calibration report in the system of the fiducial marks."""
    interior: Literal["similarity", "affine", "bilinear"] = "affine"
    mirrored: Annotated[bool, Strict()] = False
    """Whether the film was scanned through its back, so that left and right are exchanged."""
    size: tuple[Pixels, Pixels] | None = None
    """Width and height of the scans in pixels, where all are equal."""
    marks: Marks | None = None
    """What the fiducial marks look like: one description for all, or one for each by name."""

    comments: ClassVar[Mapping[str, str]] = {
        "type": "scanned film; each image states its measured fiducial marks",
        "camera_constant_mm": "",
        "principal_point_mm": "in the system of the fiducial marks, x right, y up",
        "interior": '"similarity", "affine" or "bilinear": from the marks to the scan',
        "mirrored": "true if the film was scanned through its back",
        "size": "width and height of the scans, pixels",
        "fiducials_mm": "calibrated marks: name = [x, y]",
        "marks": "what the marks look like, mm",
    }

    @field_validator("fiducials_mm")
    @classmethod
    def _marks(cls, marks: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        if len(set(marks.values())) != len(marks):
            twice = sorted(n for n, at in marks.items() if list(marks.values()).count(at) > 1)
            raise ValueError(f"fiducial marks {', '.join(twice)} have the same coordinates")
        return marks

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.lens.needs == "px":
            raise ValueError("unit px has no meaning for the lens of a film camera; allowed are tangent and mm")
        if isinstance(self.marks, EachMark):
            described, names = set(self.marks.__pydantic_extra__), ", ".join(self.fiducials_mm)
            unknown, bare = sorted(described - set(self.fiducials_mm)), sorted(set(self.fiducials_mm) - described)
            if unknown:
                raise ValueError(f"marks describes {', '.join(unknown)}; fiducials_mm has {names}")
            if bare:
                raise ValueError(f"marks does not describe fiducial mark {', '.join(bare)}")
        needed = MODELS[self.interior]
        if len(self.fiducials_mm) < needed:
            raise ValueError(f"{len(self.fiducials_mm)} fiducial marks; {self.interior} needs at least {needed}")
        return self

    @property
    def pixels(self) -> None:
        """Each scan has its own."""
        return None

    @property
    def states_pixels(self) -> bool:
        """Never: the marks are in millimetres."""
        return False

    @property
    def odd_in_x(self) -> frozenset[str]:
        """Name the values that change their sign when x of the image is counted the other way."""
        return self.lens.odd_in_x | {"x0"}

    def x_reversed(self) -> Self:
        """Return the camera with x of marks, principal point and lens reversed."""
        x, y = self.principal_point_mm
        return self.model_copy(
            update={
                "fiducials_mm": {name: (-mark[0] + 0.0, mark[1]) for name, mark in self.fiducials_mm.items()},
                "principal_point_mm": (-x + 0.0, y),
                "lens": self.lens.x_reversed(),
            }
        )

    @property
    def fiducial_system(self) -> FiducialSystem:
        """The fiducial marks."""
        return FiducialSystem(self.fiducials_mm, self.interior, self.mirrored, self.marks)

    def interior_orientation(self, size: tuple[int, int], fiducials: Fiducials | None) -> Interior:
        """Interior orientation of a scan from its measured marks; raises as `FiducialSystem.fit`."""
        plane_to_pixel = self.fiducial_system.fit(fiducials).transformation
        return Interior(self.camera_constant_mm, self.principal_point_mm, plane_to_pixel, size)

    def check_fiducials(self, fiducials: Fiducials, sized: bool, name: str) -> None:
        """Marks of a scan are the camera's, and enough."""
        if not sized:
            raise ValueError(
                "size = [width, height] of the scan is stated neither here nor for its camera, and its file "
                "cannot be read; give the scan, or state the size"
            )
        unknown = [n for n in fiducials if n not in self.fiducials_mm]
        if unknown:
            raise ValueError(
                f"fiducial marks {', '.join(unknown)} are not among those of camera {name!r}:"
                f" {', '.join(self.fiducials_mm)}"
            )
        needed = MODELS[self.interior]
        if len(fiducials) < needed:
            missing = [n for n in self.fiducials_mm if n not in fiducials]
            raise ValueError(
                f"{len(fiducials)} fiducial marks measured, {self.interior} needs {needed}; "
                f"missing {', '.join(missing)}"
            )
