"""Images with a camera and a pose."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, Strict, model_validator

from photoplan.errors import InputError
from photoplan.io.camera.model import Fiducials, Name, NotNegative, Triple
from photoplan.io.project.image import ImageEntry

Correlation = tuple[Annotated[float, Strict(), Field(ge=-1, le=1)], ...]


class Image(ImageEntry):
    """One image with a pose: oriented, or to be oriented."""

    camera: Name
    center: Triple | None = None
    """Projection centre X0, Y0, Z0 in the project's CRS and the orientation's height system, metres; None: the image
    is not oriented yet."""
    angles: Triple | None = None
    """Three angles in the sequence and unit that [orientation] states."""
    sigma_center: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """Standard deviations of the projection centre, metres, as `photoplan adjust` and `resect` found them."""
    sigma_angles: tuple[NotNegative, NotNegative, NotNegative] | None = None
    """Standard deviations of the angles, in their unit."""
    correlation: Correlation | None = None
    """The correlation matrix of centre, angles and, after a calibration, what `sigma` of the camera lists, below its
    diagonal, row by row; None: they are not correlated."""
    fiducials: Fiducials | None = None
    """Measured fiducial marks of a film scan: name = [column, row], pixels."""

    @model_validator(mode="after")
    def _both(self) -> Self:
        if (self.center is None) != (self.angles is None):
            raise ValueError("center and angles go together: give both, or none for an image that is not oriented")
        if self.correlation is not None and (self.sigma_center is None or self.sigma_angles is None):
            raise ValueError("correlation goes with sigma_center and sigma_angles")
        return self

    @property
    def geometry_file(self) -> None:
        """Its geometry stands in the project."""
        return None

    @property
    def described_by(self) -> str:
        """Its camera."""
        return self.camera

    @property
    def pose_numbers(self) -> tuple[Triple, Triple]:
        """Projection centre and angles as stated.

        Raises
        ------
        InputError
            The image is not oriented.
        """
        if self.center is None or self.angles is None:
            raise InputError(
                f"image {self.name!r} has no orientation; `photoplan resect` or `photoplan adjust` determines it"
            )
        return self.center, self.angles
