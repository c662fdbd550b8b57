"""Images of frame cameras that a file orients: planetary missions."""

from __future__ import annotations

from pydantic import field_validator

from photoplan.io.project.image import ImageEntry, InputName, plain_file


class FrameImage(ImageEntry):
    """One image of a frame camera, whose interior and exterior orientation a file states."""

    frame: InputName
    """File of camera and orientation."""

    @field_validator("frame")
    @classmethod
    def _frame(cls, text: str) -> str:
        return plain_file(text)

    @property
    def geometry_file(self) -> str:
        """That file."""
        return self.frame

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None
