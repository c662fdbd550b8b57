"""Options of an orientation file or a table that it does not state: columns, delimiter, conventions of angles."""

from __future__ import annotations

from typing import Literal, Self

from photoplan.errors import UsageError
from photoplan.request import Request, opt

Direction = Literal["camera-to-ground", "ground-to-camera"]
_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}


class TableFormat(Request):
    """Form and conventions of a table of numbers.

    A file format with conventions of its own gives way to those that are set, also to the value of the default.
    """

    columns: str | None = opt(
        "Columns of a table: name,x,y,z,omega,phi,kappa[,camera] in their order, - for one that is not used; or by the "
        "header: name=LABEL,x=…",
        None,
        section="input",
    )
    delimiter: str | None = opt("Delimiter of a table [the one that splits all lines equally].", None,
                                choices=_DELIMITERS, section="input")  # fmt: skip
    decimal_comma: bool = opt("Numbers of a table are written 1,5.", False, section="input")
    angle_unit: Literal["deg", "gon", "rad"] = opt("Unit of angles [deg, or the format's own].", "deg", section="input")
    rotation: Literal["opk", "pok", "kpo", "kop", "okp", "pko"] = opt(
        "Order of omega, phi, kappa, whatever the order of columns; the first is primary [opk, or the format's own].",
        "opk",
        section="input",
    )
    direction: Direction = opt(
        "Direction of the file's rotation [camera-to-ground; some formats require it].",
        "camera-to-ground",
        flag="rotation-direction",
        section="input",
    )

    def check(self) -> None:
        """Refuse unknown delimiters, and a comma with two meanings."""
        if self.delimiter not in (None, *_DELIMITERS.values()):
            raise UsageError(f"delimiter {self.delimiter!r} must be one of {', '.join(_DELIMITERS)}")
        if self.delimiter == "," and self.decimal_comma:
            raise UsageError("a comma cannot be both delimiter and decimal sign")

    @classmethod
    def of(cls, angle_unit: str, rotation: str) -> Self:
        """Return the format of a table in the conventions of a project; usual ones yield to the file's own."""
        usual, given = cls(), {"angle_unit": angle_unit, "rotation": rotation}
        return cls(**{name: value for name, value in given.items() if value != getattr(usual, name)})

    def declares(self, name: str) -> bool:
        """Return whether a convention was set."""
        return name in self.model_fields_set

    def conventions(self, angle_unit: str, rotation: str, direction: Direction) -> tuple[str, str, Direction]:
        """Return angle unit, rotation and direction for a format that defines its own, unless others are declared."""
        return (
            self.angle_unit if self.declares("angle_unit") else angle_unit,
            self.rotation if self.declares("rotation") else rotation,
            self.direction if self.declares("direction") else direction,
        )
