"""Events that are kept, for tests."""

from __future__ import annotations

from collections import Counter
from typing import Any


class Told:
    """All that was told."""

    def __init__(self) -> None:
        self.phases: list[tuple[str, int, str]] = []
        self.units: Counter[str] = Counter()
        """Units done, by phase."""
        self.added: Counter[str] = Counter()
        """Units added to the total of a phase after it began."""
        self.begun: list[tuple[float, str]] = []
        """What parts under way added up to, and what was done there, whenever that was told."""
        self.pixels = 0
        self.talked: list[str] = []
        self.results: list[Any] = []

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        self.phases.append((phase, units, unit))

    def done(self, units: int = 1, pixels: int = 0, begun: float = 0.0, what: str = "") -> None:
        self.units[self.phases[-1][0]] += units
        self.pixels += pixels
        if begun or what:
            self.begun.append((begun, what))

    def kept(self, units: int) -> None:
        self.units[self.phases[-1][0]] += units

    def more(self, units: int) -> None:
        self.added[self.phases[-1][0]] += units

    def talk(self, text: str) -> None:
        self.talked.append(text)

    def result(self, value: object) -> None:
        self.results.append(value)
