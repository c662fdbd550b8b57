"""Images with rational polynomials: satellites."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from photoplan.cameras.plane import Affine2D
from photoplan.io.camera.model import Number, Pair
from photoplan.io.project.image import ImageEntry, InputName, plain_file

#: What `rpc` says if the image file holds them itself.
TAGS = "tags"


class RpcImage(ImageEntry):
    """One image whose geometry a file of rational polynomials states, or the image file itself."""

    rpc: InputName
    """``tags``: the image file holds them; else the file that does."""
    shift: Pair | None = None
    """What is added to the polynomials' column and row, pixels."""
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
        if self.shift is None:
            return ()
        known = "accuracy not stated"
        if self.covariance is not None:
            known = f"± {self.covariance[0] ** 0.5:.2g}, {self.covariance[2] ** 0.5:.2g} px"
        x, y = self.shift
        return (f"polynomials are corrected by {x:+.2f}, {y:+.2f} px ({known})",)

    @property
    def correction(self) -> Affine2D | None:
        """From the polynomials' positions to those in the image; None: they are equal."""
        if self.shift is None and self.drift is None:
            return None
        (x, y), (xx, xy, yx, yy) = self.shift or (0.0, 0.0), self.drift or (0.0, 0.0, 0.0, 0.0)
        return Affine2D(a1=1.0 + xx, a2=xy, a3=x, a4=yx, a5=1.0 + yy, a6=y)
