"""Lines that were delivered as single segments, joined into the lines that they are parts of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from photoplan.surfaces.measured import MeasuredLine
from photoplan.terrain.clean.borders import Finding
from photoplan.terrain.clean.join import clusters

#: Single segments of a class that are told, where they are half of its lines at least: others are short lines.
_MANY = 5
_End = tuple[int, int]
"""Number of a line, and which of its ends: 0 or -1."""


def joined_segments(
    lines: Sequence[MeasuredLine], tolerance: float, height_tolerance: float
) -> tuple[list[MeasuredLine], list[Finding]]:
    """The lines, with single segments (two vertices) joined to what goes on where they end.

    Two ends are joined where they are the only ones of their class, code and accuracy at a place, one of the two lines
    is a single segment, and their heights agree. Two-sided breaklines keep their direction, others may be turned round.
    """
    single = np.array([len(line.xyz) == 2 for line in lines], bool)
    if not single.any():
        return list(lines), []
    partner = _partners(lines, single, tolerance, height_tolerance)
    out: list[MeasuredLine] = []
    used: set[int] = set()
    for first in range(len(lines)):
        if first in used:
            continue
        chain = _chain(first, partner)
        used.update(number for number, _ in chain)
        out.append(_joined([lines[number] for number, _ in chain], [turned for _, turned in chain], lines[first].name))
    return out, _told(len(lines) - len(out), out)


def _partners(
    lines: Sequence[MeasuredLine], single: NDArray[np.bool_], tolerance: float, height_tolerance: float
) -> dict[_End, _End]:
    """The end that each end goes on at."""
    ends: list[_End] = [(k, end) for k in range(len(lines)) for end in (0, -1)]
    place = clusters(np.array([lines[k].xyz[end, :2] for k, end in ends]), tolerance)
    groups: dict[object, list[_End]] = {}
    for (k, end), at in zip(ends, place.tolist()):
        line = lines[k]
        groups.setdefault((at, line.kind, line.code, line.sigma, line.right is None), []).append((k, end))
    found: dict[_End, _End] = {}
    for group in groups.values():
        if len(group) != 2 or group[0][0] == group[1][0]:
            continue
        (a, end_a), (b, end_b) = group
        one, other = lines[a], lines[b]
        sides = [(one.xyz[end_a, 2], other.xyz[end_b, 2])]
        if one.right is not None and other.right is not None:
            sides.append((one.right[end_a], other.right[end_b]))
        agree = all(not abs(u - v) > height_tolerance for u, v in sides)
        if (single[a] or single[b]) and agree and (one.right is None or end_a != end_b):
            found[a, end_a], found[b, end_b] = (b, end_b), (a, end_a)
    return found


def _chain(first: int, partner: dict[_End, _End]) -> list[tuple[int, bool]]:
    """Numbers of the lines that hang together, in order, and whether each is turned round."""
    number, end = first, 0
    while (number, end) in partner:
        number, end = partner[number, end]
        end = -1 - end
        if number == first:
            break  # a ring
    chain = [(number, end == -1)]
    end = -1 - end
    while (number, end) in partner:
        number, end = partner[number, end]
        if number == chain[0][0]:
            break
        chain.append((number, end == -1))
        end = -1 - end
    return chain


def _joined(parts: Sequence[MeasuredLine], turned: Sequence[bool], name: str) -> MeasuredLine:
    if len(parts) == 1:
        return parts[0]
    runs = [line.xyz[::-1] if back else line.xyz for line, back in zip(parts, turned)]
    xyz = np.concatenate([runs[0], *(run[1:] for run in runs[1:])])
    rights = [line.right for line in parts]
    right = None
    if rights[0] is not None:
        right = np.concatenate([rights[0], *(r[1:] for r in rights[1:] if r is not None)])
    return replace(parts[0], name=name, xyz=xyz, right=right)


def _told(joined: int, lines: Sequence[MeasuredLine]) -> list[Finding]:
    found = []
    if joined:
        text = f"{joined} pieces that came as single segments joined to the lines that they go on"
        found.append(Finding("joined segments", text))
    classes: dict[tuple[str, str], list[MeasuredLine]] = {}
    for line in lines:
        classes.setdefault((line.kind, line.code), []).append(line)
    for (kind, code), some in classes.items():
        left = [line for line in some if len(line.xyz) == 2]
        if len(left) < _MANY or 2 * len(left) < len(some):
            continue
        X, Y = left[0].xyz[0, :2].tolist()
        text = (
            f"{len(left)} of {len(some)} {kind}s{f' of code {code}' if code else ''} are single segments, for one "
            f"{left[0].name}: where they end, no other of their class goes on alone at the same height"
        )
        found.append(Finding(kind="single segments", text=text, X=X, Y=Y, names=tuple(line.name for line in left[:10])))
    return found
