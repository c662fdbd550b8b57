"""Weights of the score by which a mosaic chooses among its images; imports no library that pixels need."""

from __future__ import annotations

from dataclasses import dataclass

from photoplan.errors import UsageError


@dataclass(frozen=True)
class Weights:
    """Weights of the penalties of the score."""

    slant: float = 1.0
    coarseness: float = 1.0
    border: float = 1.0
    occlusion: float = 0.5
    sharpness: float = 0.0

    def __post_init__(self) -> None:
        odd = [f"{name}={value:g}" for name, value in vars(self).items() if not 0 <= value <= 1000]
        if odd or not any(vars(self).values()):
            what = f"weight {', '.join(odd)}" if odd else "all weights are 0"
            raise UsageError(f"score: {what}; allowed are numbers from 0 to 1000, not all of them 0")

    @classmethod
    def parse(cls, text: str) -> Weights:
        """Return the weights that ``NAME=WEIGHT,…`` states; the others are as usual."""
        values: dict[str, float] = {}
        for part in text.split(","):
            name, _, number = part.strip().partition("=")
            try:
                values[name] = float(number)
            except ValueError:
                name = ""
            if name not in cls.__dataclass_fields__:
                known = ", ".join(cls.__dataclass_fields__)
                raise UsageError(f"score {part.strip()!r}; write NAME=WEIGHT with {known}")
        return cls(**values)
