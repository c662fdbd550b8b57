"""Images of scenes that are arrays: one, or frames of a series one after the other."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.quality.formation.model import FormedFrame, FormedImage, ImageModel, exposed, frame_light

_Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ArrayScene:
    """A scene from an array; beyond its border it goes on as at the border."""

    values: _Array
    """Mean values of the cells, shape (rows · k, columns · k) or (bands, rows · k, columns · k)."""
    oversampling: int = 1
    """k: cells along a side of a pixel."""
    continuous: bool | None = None
    """Whether the cells are means of a continuous scene; else the scene consists of even squares, as Kölbl's object
    pixels. None: even squares where k is 1, else continuous."""

    def __post_init__(self) -> None:
        values = np.array(self.values, np.float64)
        values = values[None] if values.ndim == 2 else values
        if values.ndim != 3 or 0 in values.shape:
            raise InputError(f"a scene has rows and columns, or bands, rows and columns; given is shape {values.shape}")
        if (
            not 1 <= self.oversampling <= 64
            or values.shape[1] % self.oversampling
            or values.shape[2] % self.oversampling
        ):
            raise InputError(
                f"a scene of {values.shape[2]} × {values.shape[1]} cells with oversampling {self.oversampling}; needed "
                "is 1 to 64, and sides that are multiples of it"
            )
        if not np.isfinite(values).all():
            raise InputError("a scene has finite values only")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        if self.continuous is None:
            object.__setattr__(self, "continuous", self.oversampling > 1)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.values.shape[2] // self.oversampling, self.values.shape[1] // self.oversampling

    @property
    def bands(self) -> int:
        """Number of bands."""
        return int(self.values.shape[0])

    def cells(self, window: Window) -> _Array:
        """Cells of a window of pixels, shape (bands, height · k, width · k)."""
        k = self.oversampling
        rows = np.clip(np.arange(window.row * k, window.stop[1] * k), 0, self.values.shape[1] - 1)
        columns = np.clip(np.arange(window.col * k, window.stop[0] * k), 0, self.values.shape[2] - 1)
        return self.values[:, rows[:, None], columns[None, :]]


def form_image(model: ImageModel, scene: Any, frame: int = 0, exposure: float = 1.0, gain: float = 1.0) -> FormedImage:
    """One image of a scene; an array is taken as one with one cell per pixel."""
    scene = ArrayScene(scene) if isinstance(scene, np.ndarray) else scene
    return exposed(model, frame_light(model, scene, frame).whole(), FormedFrame(frame, exposure, gain))


def form_series(
    model: ImageModel, scenes: Sequence[Any], exposures: Sequence[float] | None = None
) -> Iterator[FormedImage]:
    """A frame of each scene; automatic gain runs through them."""
    gain = 1.0
    for frame, (scene, exposure) in enumerate(zip(scenes, exposures or [1.0] * len(scenes), strict=True)):
        image = form_image(model, scene, frame, exposure, gain)
        gain = image.next_gain
        yield image
