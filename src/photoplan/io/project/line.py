"""Images of line cameras: satellites, planetary missions, aerial strips."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr, field_validator

from photoplan.errors import InputError
from photoplan.io.camera.line.file import line_files
from photoplan.io.camera.model import CameraEntry, Name
from photoplan.io.project.image import Deviation, ImageEntry, InputName, plain_file


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

    _change: tuple[float, ...] = PrivateAttr(default=())

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

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """See `ImageEntry.deviations`: six parts of what its correction says of the trajectory's poses."""
        if self.correction is None:
            raise InputError(
                f"image {self.name!r}: nothing is known of the accuracy of its trajectory; `photoplan adjust` writes "
                "it into the file of its `correction`, as [accuracy]"
            )
        return tuple(("trajectory", row) for row in np.eye(6))

    def moved(
        self, change: NDArray[np.float64], cameras: Mapping[str, CameraEntry]
    ) -> tuple[LineImage, Mapping[str, CameraEntry]]:
        """See `ImageEntry.moved`; on a flight without tremor, which makes no difference to errors."""
        image = self.model_copy()
        image._change = tuple(change.tolist())
        return image, cameras

    @property
    def change(self) -> tuple[float, ...]:
        """Parts of the errors of its trajectory by which it is moved; empty: it is as it is."""
        return self._change

    @property
    def described_by(self) -> None:
        """It needs no table of cameras."""
        return None
