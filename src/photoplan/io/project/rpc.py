"""Images with rational polynomials: satellites."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from photoplan.cameras.plane import Affine2D
from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry, Number, Pair, Positive
from photoplan.io.project.image import Deviation, ImageEntry, InputName, plain_file

#: What `rpc` says if the image file holds them itself.
TAGS = "tags"

#: Standard deviations of shift (pixels) and drift (pixels per pixel) beyond which nothing is known of an image.
_MOST_DEVIATION = (1e6, 1e6, 1.0, 1.0, 1.0, 1.0)


class RpcImage(ImageEntry):
    """One image whose geometry a file of rational polynomials states, or the image file itself."""

    rpc: InputName
    """``tags``: the image file holds them; else the file that does."""
    shift: Pair | None = None
    """What is added to the polynomials' column and row, pixels."""
    scale: Positive | None = None
    """Pixels of the image file for one of the polynomials, before the shift; None: one, and sizes are compared."""
    drift: tuple[Number, Number, Number, Number] | None = None
    """What is added beside: to the column by column and row, to the row by column and row, per pixel."""
    covariance: Annotated[tuple[Number, ...], Field(max_length=21)] | None = None
    """Of shift and drift: the lower triangle by rows, of two or six numbers; pixels and pixels per pixel."""

    @field_validator("rpc")
    @classmethod
    def _rpc(cls, text: str) -> str:
        return plain_file(text)

    @field_validator("covariance")
    @classmethod
    def _covariance(cls, values: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if values is not None and len(values) not in (3, 21):
            raise ValueError(f"covariance of {len(values)} numbers; 3 of shift, or 21 of shift and drift are needed")
        if values is not None and min(values[0], values[2]) < 0:
            raise ValueError("covariance with a variance below 0; it is the lower triangle by rows")
        return values

    @property
    def geometry_file(self) -> str | None:
        """The file of polynomials; None: the image file holds them."""
        return None if self.rpc == TAGS else self.rpc

    @property
    def described_by(self) -> None:
        """It needs no camera."""
        return None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Its correction."""
        scaled = () if self.scale in (None, 1.0) else (f"polynomials are scaled by {self.scale:g}",)
        if self.shift is None:
            return scaled
        known = "accuracy not stated"
        if self.covariance is not None:
            known = f"± {self.covariance[0] ** 0.5:.2g}, {self.covariance[2] ** 0.5:.2g} px"
        x, y = self.shift
        return (
            *scaled,
            f"polynomials are corrected by {x:+.2f}, {y:+.2f} px ({known})",
        )

    def deviations(self, cameras: Mapping[str, CameraEntry], rotation: str) -> tuple[Deviation, ...]:
        """See `ImageEntry.deviations`: of shift and drift."""
        if self.covariance is None:
            raise InputError(
                f"image {self.name!r}: nothing is known of the accuracy of its polynomials; `photoplan adjust` writes "
                "their covariance, or state it in [[images]]: covariance = [VARIANCE OF COLUMN, 0, VARIANCE OF ROW]"
            )
        size = 2 if len(self.covariance) == 3 else 6
        C = np.zeros((size, size))
        C[np.tril_indices(size)] = self.covariance
        scale = np.sqrt(np.maximum(np.diag(C), 1e-300))
        odd = scale > np.array(_MOST_DEVIATION)[:size]
        if odd.any():
            raise InputError(
                f"image {self.name!r}: covariance says ± {scale[odd][0]:.3g} {'px' if odd[:2].any() else 'px per px'}: "
                "that is no accuracy; is it that of its polynomials?"
            )
        values, axes = np.linalg.eigh((np.tril(C) + np.tril(C, -1).T) / np.outer(scale, scale))
        if values[0] < -1e-3:
            raise InputError(f"image {self.name!r}: covariance is none; `photoplan adjust` writes it")
        return tuple(("polynomials", a * scale * np.sqrt(max(v, 0.0))) for v, a in zip(values, axes.T))

    def moved(
        self, change: NDArray[np.float64], cameras: Mapping[str, CameraEntry]
    ) -> tuple[RpcImage, Mapping[str, CameraEntry]]:
        """See `ImageEntry.moved`."""
        x, y, *rest = (
            change + np.array([*(self.shift or (0.0, 0.0)), *(self.drift or (0.0,) * 4)])[: len(change)]
        ).tolist()
        return self.model_copy(update={"shift": (x, y)} | ({"drift": tuple(rest)} if rest else {})), cameras

    @property
    def correction(self) -> Affine2D | None:
        """From the polynomials' positions to those in the image; None: they are equal."""
        if self.shift is None and self.drift is None:
            return None
        (x, y), (xx, xy, yx, yy) = self.shift or (0.0, 0.0), self.drift or (0.0, 0.0, 0.0, 0.0)
        return Affine2D(a1=1.0 + xx, a2=xy, a3=x, a4=yx, a5=1.0 + yy, a6=y)
