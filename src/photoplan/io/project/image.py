"""What is common to all images of a project, whatever their geometry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, field_validator

from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry, Entry, Name, Pixels, Restore
from photoplan.io.names import check_input_name

Deviation = tuple[str, NDArray[np.float64]]
"""An error's name, and what it changes of the numbers that state a geometry."""

InputName = Annotated[str, Field(max_length=4000)]


class ImageEntry(Entry, ABC):
    """An image, of whatever geometry.

    A kind of geometry is a file of its own with a subclass, a line in `photoplan.io.project.kinds` and one in
    `photoplan.project.cameras`.
    """

    name: Name
    """Products are called after it."""
    file: InputName
    size: tuple[Pixels, Pixels] | None = None
    """Width and height of this image, where nothing else states them."""
    alpha: Annotated[bool, Strict()] | None = None
    """Whether bands that are tagged as alpha are masks (true) or colours (false); None: their values decide."""
    restore: Restore | None = None
    """Filter that it is restored with before anything is made of it; None: that of its camera, if there is one."""
    balance: InputName | None = None
    """Balance file by which its grey values agree with those of other images, after all else; None: they stay."""

    @field_validator("file", "balance")
    @classmethod
    def _file(cls, text: str | None) -> str | None:
        return None if text is None else plain_file(text)

    @property
    @abstractmethod
    def geometry_file(self) -> str | None:
        """File that its geometry is read from, beside that of its pixels; None: there is none."""

    def geometry_files(self, resolve: Callable[[str], Path]) -> list[Path]:
        """All files that its geometry is read from, beside that of its pixels; `resolve` finds what entries name."""
        return [] if self.geometry_file is None else [resolve(self.geometry_file)]

    @property
    def unoriented(self) -> str | None:
        """Why products leave the image out; None if it is oriented."""
        return None

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a user should know of its geometry, a clause each."""
        return ()

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """Independent errors of its geometry, each one standard deviation large."""
        raise InputError(f"image {self.name!r}: its kind of geometry states no accuracy that a raster could be made of")

    def moved(
        self, change: NDArray[np.float64], cameras: Mapping[str, CameraEntry]
    ) -> tuple[ImageEntry, Mapping[str, CameraEntry]]:
        """It and the cameras with its geometry changed by a part of one of its `deviations`."""
        raise NotImplementedError

    @property
    @abstractmethod
    def described_by(self) -> str | None:
        """Name of the [cameras.NAME] table that it needs; None: it needs none."""


def plain_file(text: str) -> str:
    """A name of a file as an entry states it; raises ValueError where no file can have it."""
    try:
        return check_input_name(text)
    except InputError as error:
        raise ValueError(str(error)) from None
