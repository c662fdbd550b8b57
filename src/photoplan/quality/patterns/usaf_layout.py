"""Where the elements of the USAF-1951 target are: groups, elements, and both directions of bars.

The target of MIL-STD-150A: element E of group G has 2^(G + (E − 1)/6) line pairs per millimetre, three bars of a length
of 2.5 periods in each direction. Groups come in pairs. Of an even group the first element stands at the lower right and
the other five at the left; the elements of the odd group that follows stand at the right. The next pair is the same,
four times smaller, inside. The positions were measured in ``USAF1951_template.png`` of LAB-UMK/usaf1951 (MIT licence);
the four groups there are similar to each other within 1.6 of 2000 pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

#: Half the side of the square that three bars fill, periods.
HALF = 1.25

#: Columns of horizontal and of vertical bars, and their row, in periods of the pair's first element from the centre
#: about which pairs are similar. Columns go to the right, rows downwards.
_PAIR: tuple[tuple[tuple[float, float, float], ...], ...] = (
    (
        (3.870, 0.369, 6.216),
        (-7.761, -4.649, -6.006),
        (-7.882, -5.107, -2.246),
        (-7.994, -5.518, 1.112),
        (-8.089, -5.885, 4.099),
        (-8.184, -6.218, 6.770),
    ),
    (
        (4.570, 2.824, -6.477),
        (4.639, 3.083, -4.386),
        (4.700, 3.312, -2.527),
        (4.756, 3.515, -0.841),
        (4.803, 3.701, 0.676),
        (4.847, 3.865, 1.994),
    ),
)


@dataclass(frozen=True)
class UsafElement:
    """Three bars of the target."""

    step: int
    """Group, counted from the largest one in the picture's pair (0, 1, 2, …)."""
    element: int
    """1 to 6."""
    horizontal: bool
    """The bars lie along the rows of the target; else along its columns."""
    x: float
    """Centre of the three bars, in periods of the first element of group 0."""
    y: float

    @property
    def period(self) -> float:
        """In periods of the first element of group 0."""
        return float(2.0 ** -(self.step + (self.element - 1) / 6.0))


def usaf_layout(groups: int) -> Iterator[UsafElement]:
    """All elements of so many groups, from large to small."""
    for step in range(groups):
        scale = 0.25 ** (step // 2)
        for k, (horizontal, vertical, row) in enumerate(_PAIR[step % 2]):
            yield UsafElement(step, k + 1, True, scale * horizontal, scale * row)
            yield UsafElement(step, k + 1, False, scale * vertical, scale * row)


def usaf_frequency(group: int, element: int) -> float:
    """Line pairs per millimetre of an element (MIL-STD-150A)."""
    return float(2.0 ** (group + (element - 1) / 6.0))
