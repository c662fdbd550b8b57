"""Images with rational polynomials: satellites."""

from __future__ import annotations

from pydantic import field_validator

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

    @field_validator("rpc")
    @classmethod
    def _rpc(cls, text: str) -> str:
        return plain_file(text)

    @property
    def geometry_file(self) -> str | None:
        """The file of polynomials; None: the image file holds them."""
        return None if self.rpc == TAGS else self.rpc

    @property
    def described_by(self) -> None:
        """It needs no camera."""
        return None

    @property
    def correction(self) -> Affine2D | None:
        """From the polynomials' positions to those in the image; None: they are equal."""
        if self.shift is None and self.drift is None:
            return None
        (x, y), (xx, xy, yx, yy) = self.shift or (0.0, 0.0), self.drift or (0.0, 0.0, 0.0, 0.0)
        return Affine2D(a1=1.0 + xx, a2=xy, a3=x, a4=yx, a5=1.0 + yy, a6=y)
