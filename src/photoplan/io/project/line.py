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
    correction: InputName | None = None
    """File of corrections of its trajectory, as `photoplan adjust` writes them."""
    mount: Name | None = None
    """Images of one mount share boresight, lever arm and clock in an adjustment; None: those of one file do."""

    @field_validator("line", "correction")
    @classmethod
    def _line(cls, text: str | None) -> str | None:
        return None if text is None else plain_file(text)

    @property
    def geometry_file(self) -> str:
        """The file of the line camera."""
        return self.line

    def geometry_files(self, resolve: Callable[[str], Path]) -> list[Path]:
        """That file, the record of the flight beside it, and the corrections."""
        correction = [] if self.correction is None else [resolve(self.correction)]
        return [*line_files(resolve(self.line)), *correction]

    @property
    def remarks(self) -> tuple[str, ...]:
        """Its correction."""
        return () if self.correction is None else (f"trajectory is corrected by {self.correction}",)

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None
