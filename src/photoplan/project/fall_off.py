"""Light fall-off of source images, corrected while they are read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import Pixels
from photoplan.io.fall_off_file import read_fall_off_entry
from photoplan.io.fingerprint import fingerprint
from photoplan.plain import pick
from photoplan.quality.camera.fall_off_model import FallOffModel, correct_fall_off, largest_gain
from photoplan.quality.linearise import Linearisation
from photoplan.quality.restoration.restorer import light_of


def read_fall_off(path: Path) -> FallOffModel:
    """The model of a correction file; `photoplan.quality.camera.fall_off_model.correct_fall_off` applies it."""
    entry = read_fall_off_entry(path)
    try:
        return FallOffModel(
            size=entry.size,
            principal_point=entry.principal_point_px,
            camera_constant=entry.camera_constant_px,
            terms=tuple((term.n, term.m) for term in entry.terms),
            coefficients=tuple(term.coefficient for term in entry.terms),
            dark=entry.dark_dn,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


@dataclass(frozen=True)
class FallOffFile:
    """A correction and the file that it comes from."""

    path: Path
    model: FallOffModel
    gain: float
    """The largest in the image: noise grows by it there."""
    digest: str

    def json_fields(self) -> dict[str, Any]:
        """The model by its entries."""
        model = self.model
        return {
            **pick(self, "path", sampled_sha256="digest", largest_gain="gain"),
            **pick(
                model,
                "size",
                principal_point_px="principal_point",
                camera_constant_px="camera_constant",
                dark_dn="dark",
            ),
            "terms": [[n, m, value] for (n, m), value in zip(model.terms, model.coefficients)],
        }


def load_fall_off(path: Path) -> FallOffFile:
    """A correction of a file that `photoplan characterise` wrote."""
    model = read_fall_off(path)
    try:
        return FallOffFile(path, model, largest_gain(model), fingerprint(path).digest)
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(str(path)) else f"{path}: {message}") from None


def fall_off_line(used: FallOffFile) -> str:
    """A correction in words."""
    return f"light fall-off corrected by {used.path.name}: gain up to {used.gain:.3g}, noise there grows with it"


@dataclass(frozen=True, eq=False)
class FallOffStep:
    """Grey values to light with the fall-off corrected, the same gain in all bands.

    Grey values are decoded to light and corrected; what comes out is float32 on the scale of the image's type, neither
    rounded nor clipped. The grey value of no light is decoded by the same curve.
    """

    fall_off: FallOffFile
    linearisation: Linearisation
    stored: np.dtype[Any]
    """Type of the image."""

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The correction is for images of one size."""
        known = self.fall_off.model.size
        if size != known:
            raise InputError(
                f"{size[0]} × {size[1]} pixels; the light fall-off in {self.fall_off.path} is for "
                f"images of {known[0]} × {known[1]}: an image that was cropped or scaled needs a correction of its own"
            )

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """Float32, whatever the image has."""
        return np.dtype(np.float32)

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """The window itself."""
        return window

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Light of a window and its validity."""
        light = np.empty(pixels.shape, np.float32)
        dark = np.zeros((pixels.shape[0], 1, 1), np.float32)
        for band, grey in enumerate(pixels, start=1):
            if valid is not None and not valid.any():
                light[band - 1] = 0.0
                continue
            light[band - 1] = light_of(self.linearisation, grey, valid, band)
            dark[band - 1] = self._dark(band)
        corrected, _ = correct_fall_off(light - dark, window, replace(self.fall_off.model, dark=0.0))
        return corrected + dark, valid

    def _dark(self, band: int) -> float:
        """Light of the grey value of no light: that of a fraction of the type's scale, too."""
        dark, curve = self.fall_off.model.dark, self.linearisation
        if curve.is_linear or dark == 0.0:
            return dark
        scale = curve.full_scale(self.stored) if curve.kind == "srgb" else 1.0
        return float(curve.to_linear(np.array([dark / scale]), band)[0]) * scale
