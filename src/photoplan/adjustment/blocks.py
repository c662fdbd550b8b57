"""Blocks of unknowns: their names, their positions in the vector of unknowns, and how a step changes them.

An adjustment asks nothing else of its unknowns. A new kind (the knots of a trajectory, corrections of an RPC) is a
value with an update rule, a line in the layout, and the rows that have it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]
_Index = NDArray[np.int64]


class Unknowns(Protocol):
    """Values of all blocks of one kind."""

    def moved(self, step: _Floats) -> Unknowns:
        """The values after a step (blocks, parameters)."""


@dataclass(frozen=True, eq=False)
class Kind:
    """Blocks of one kind: as many as have an owner, each of the same parameters."""

    key: str
    """Of its values, by which a layout finds it."""
    owners: tuple[str, ...]
    """What each block belongs to."""
    parameters: tuple[str, ...]
    """How messages call them; {} stands for the owners: "X0 of {}"."""
    owner: str = ""
    """What an owner is: "image"."""
    first: int = 0
    """Column of the first unknown; those of a block stand together."""

    @property
    def width(self) -> int:
        """Unknowns of a block."""
        return len(self.parameters)

    @property
    def part(self) -> slice:
        """The columns of all blocks."""
        return slice(self.first, self.first + self.width * len(self.owners))

    def at(self, block: _Index) -> _Index:
        """First column of blocks."""
        return self.first + self.width * block

    def columns(self, block: int = 0) -> _Index:
        """All columns of a block."""
        return self.first + self.width * block + np.arange(self.width)

    def called(self, parameter: int, blocks: Iterable[int] = (0,)) -> str:
        """A parameter of some blocks, of which the first three are named: "X0 of images 'a', 'b', 'c' and 2 more"."""
        chosen = list(blocks)
        names = ", ".join(repr(self.owners[k]) for k in chosen[:3])
        more = f" and {len(chosen) - 3} more" if len(chosen) > 3 else ""
        return self.parameters[parameter].format(f"{self.owner}{'s' * (len(chosen) > 1)} {names}{more}")


@dataclass(frozen=True, eq=False)
class Layout:
    """The unknowns of an adjustment in their order."""

    kinds: tuple[Kind, ...]

    @classmethod
    def of(cls, kinds: Iterable[Kind]) -> Layout:
        """Kinds one after the other; those without parameters are none."""
        placed: list[Kind] = []
        for kind in kinds:
            if kind.parameters and kind.owners:
                placed.append(replace(kind, first=placed[-1].part.stop if placed else 0))
        return cls(tuple(placed))

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return self.kinds[-1].part.stop if self.kinds else 0

    def get(self, key: str) -> Kind | None:
        """The kind of a key; None: its values are held fixed."""
        return next((kind for kind in self.kinds if kind.key == key), None)

    def columns_of(self, key: str) -> _Index:
        """Columns of all unknowns of a kind, in the order of its values; none of a kind that is held fixed."""
        kind = self.get(key)
        return np.arange(0) if kind is None else np.arange(kind.part.start, kind.part.stop)

    def moved(self, values: Mapping[str, Unknowns], step: _Floats) -> dict[str, Unknowns]:
        """Values after a step (count,); what is no unknown stays."""
        moved = {k.key: values[k.key].moved(step[k.part].reshape(-1, k.width)) for k in self.kinds}
        return {**values, **moved}

    def spelled(self, direction: _Floats, scale: _Floats) -> str:
        """The unknowns that take part in a direction, the largest part first."""
        parts: list[tuple[float, str]] = []
        most = max(len(kind.owners) for kind in self.kinds)
        for kind in self.kinds:
            share = direction[kind.part].reshape(-1, kind.width) ** 2
            for k in range(kind.width):
                if len(kind.owners) == most > 1:
                    if share[:, k].sum() > 0.02:
                        large = np.flatnonzero(share[:, k] > 0.1 * share[:, k].max())
                        parts.append((float(share[:, k].sum()), kind.called(k, large.tolist())))
                    continue
                # Few against many: a camera's share is small, but it is the point.
                for block in np.flatnonzero(share[:, k] > 1e-6).tolist():
                    column = kind.columns(block)[k]
                    parts.append((1.0, f"{kind.called(k, (block,))} ({direction[column] * scale[column]:+.2g})"))
        if not parts:
            column = int(np.argmax(np.abs(direction)))
            kind = next(kind for kind in self.kinds if column < kind.part.stop)
            block, k = divmod(column - kind.first, kind.width)
            parts.append((1.0, kind.called(k, (block,))))
        return " with ".join(text for _, text in sorted(parts, key=lambda p: -p[0]))
