"""Images of line cameras: satellites, planetary missions, aerial strips."""

from __future__ import annotations

from pydantic import field_validator

from photoplan.io.project.image import ImageEntry, InputName, plain_file


class LineImage(ImageEntry):
    """One image of a line camera, whose trajectory and directions a file states."""

    line: InputName
    """File of the line camera."""

    @field_validator("line")
    @classmethod
    def _line(cls, text: str) -> str:
        return plain_file(text)

    @property
    def geometry_file(self) -> str:
        """The file of the line camera."""
        return self.line

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None
