"""Images of line cameras: satellites, planetary missions, aerial strips."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import field_validator

from photoplan.io.camera.line.file import line_files
from photoplan.io.camera.model import Name
from photoplan.io.project.image import ImageEntry, InputName, plain_file


class LineImage(ImageEntry):
    """One image of a line camera, whose trajectory and directions a file states."""

    line: InputName
    """File of the line camera."""
    detectors: Name | None = None
    """Which line of detectors, where the file has several."""

    @field_validator("line")
    @classmethod
    def _line(cls, text: str) -> str:
        return plain_file(text)

    @property
    def geometry_file(self) -> str:
        """The file of the line camera."""
        return self.line

    def geometry_files(self, resolve: Callable[[str], Path]) -> list[Path]:
        """That file, and the record of the flight beside it."""
        return line_files(resolve(self.line))

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None
