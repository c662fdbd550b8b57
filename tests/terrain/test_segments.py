"""Lines that come as single segments are joined, and what stays single is told."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from photoplan.io.terrain.files import read_measured
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, PointGroup
from photoplan.terrain.clean import HEIGHT_TOLERANCE, TOLERANCE, Finding, clean, joined_segments

CORNERS = PointGroup("p", "mass", np.array([[-99.0, -99, 0], [99, -99, 0], [0, 99, 0]]), np.arange(1, 4))


def line(xyz: object, kind: str = "breakline", **more: object) -> MeasuredLine:
    return MeasuredLine("a", kind, np.asarray(xyz, float), **more)  # type: ignore[arg-type]


def joined(lines: list[MeasuredLine]) -> tuple[list[MeasuredLine], list[Finding]]:
    return joined_segments(lines, TOLERANCE, HEIGHT_TOLERANCE)


def pieces(whole: MeasuredLine) -> list[MeasuredLine]:
    return [
        replace(whole, xyz=whole.xyz[k : k + 2], right=None if whole.right is None else whole.right[k : k + 2])
        for k in range(len(whole.xyz) - 1)
    ]


def canonical(xyz: NDArray[np.float64]) -> list[list[float]]:
    """Vertices from the smaller end on; of a ring from its smallest vertex, in the direction of the smaller next."""
    rows = xyz.tolist()
    if rows[0] == rows[-1]:
        at = rows.index(min(rows))
        rows = rows[at:-1] + rows[: at + 1]
    return min(rows, rows[::-1])


@given(st.data())
def test_lines_cut_into_segments_come_back(data: st.DataObject) -> None:
    """Of several lines, open and closed, in any order and direction; walls keep theirs."""
    rng = np.random.default_rng(data.draw(st.integers(0, 10_000)))
    wholes = []
    for k in range(data.draw(st.integers(1, 4))):
        xyz = rng.uniform(0, 50, (data.draw(st.integers(3, 7)), 3)) + np.array([100.0 * k, 0, 0])
        if data.draw(st.booleans()):
            xyz = np.vstack([xyz, xyz[:1]])
        wall = data.draw(st.booleans())
        right = xyz[:, 2] - 2 if wall else None
        wholes.append(
            line(xyz, data.draw(st.sampled_from(["breakline"] if wall else ["formline", "border"])), right=right)
        )
    parts = [
        replace(part, xyz=part.xyz[::-1]) if part.right is None and rng.random() < 0.5 else part
        for whole in wholes
        for part in pieces(whole)
    ]
    rng.shuffle(parts)  # type: ignore[arg-type]
    out, found = joined(parts)
    assert [f.kind for f in found] == ["joined segments"]
    assert sorted(canonical(x.xyz) for x in out) == sorted(canonical(w.xyz) for w in wholes)
    for wall in (x for x in out if x.right is not None):
        assert np.array_equal(wall.right, wall.xyz[:, 2] - 2)
        whole = next(w for w in wholes if canonical(w.xyz) == canonical(wall.xyz))
        steps = {tuple(np.diff(whole.xyz[k : k + 2], axis=0)[0]) for k in range(len(whole.xyz) - 1)}
        assert {tuple(np.diff(wall.xyz[k : k + 2], axis=0)[0]) for k in range(len(wall.xyz) - 1)} == steps


@pytest.mark.parametrize(
    "other",
    [
        line([[1, 0, 5], [2, 0, 5]], code="7"),
        line([[1, 0, 5], [2, 0, 5]], "formline"),
        line([[1, 0, 5], [2, 0, 5]], sigma=0.1),
        line([[1, 0, 5.2], [2, 0, 5]]),
        line([[1.01, 0, 5], [2, 0, 5]]),
        line([[1, 0, 5], [2, 0, 5]], right=np.array([4.0, 4.0])),
    ],
    ids=["code", "kind", "sigma", "height", "place", "wall"],
)
def test_segments_that_do_not_belong_together_stay(other: MeasuredLine) -> None:
    lines = [line([[0, 0, 5], [1, 0, 5]]), other]
    out, found = joined(lines)
    assert out == lines and not found
    assert len(joined([lines[0], line([[2, 0, 5], [1, 0, 5]])])[0]) == 1


def test_walls_are_not_turned_and_long_lines_stay_as_measured() -> None:
    wall = [line(x, right=np.zeros(2)) for x in ([[0, 0, 5], [1, 0, 5]], [[2, 0, 5], [1, 0, 5]])]
    assert joined(wall)[0] == wall
    long = [line([[0, 0, 5], [1, 0, 5], [2, 0, 5]]), line([[2, 0, 5], [3, 0, 5], [4, 0, 5]])]
    far = line([[9, 9, 1], [12, 9, 1]])
    assert joined([*long, far])[0] == [*long, far]
    (one,), _ = joined([long[0], line([[3, 1, 5], [2, 0, 5]])])
    assert one.xyz[:, 0].tolist() == [0, 1, 2, 3]


def test_what_stays_single_is_told_by_class() -> None:
    fork = [line([[0, 0, 5], [np.cos(a), np.sin(a), 5]], code="ditch") for a in range(5)]
    _, found = clean(MeasuredTerrain((CORNERS,), (*fork, line([[9, 9, 1], [12, 9, 1]], "formline"))))
    (told,) = (f for f in found if f.kind == "single segments")
    assert "5 of 5 breaklines of code ditch are single segments" in told.text


def test_lines_of_a_drawing_are_one_border_and_one_edge(tmp_path: Path) -> None:
    """DXF LINE entities, as many programs write polylines: a border made of them is closed, and no error."""
    corners = [(0, 0), (40, 0), (40, 40), (0, 40), (0, 0)]
    edge = [(5, 20), (12, 22), (20, 20), (30, 21)]
    entities = ""
    for layer, xy in (("BORDER", corners), ("BREAKLINE", edge)):
        for (x, y), (u, v) in pairwise(xy):
            entities += f"0\nLINE\n8\n{layer}\n10\n{x}\n20\n{y}\n30\n7\n11\n{u}\n21\n{v}\n31\n7\n"
    for x, y in ((10, 10), (30, 10), (20, 30)):
        entities += f"0\nPOINT\n8\nMASS\n10\n{x}\n20\n{y}\n30\n7\n"
    path = tmp_path / "a.dxf"
    path.write_text(f"0\nSECTION\n2\nENTITIES\n{entities}0\nENDSEC\n0\nEOF\n")
    out, found = clean(read_measured([path]))
    assert {x.kind: len(x.xyz) for x in out.lines} == {"border": 5, "breakline": 4}
    assert [f.text for f in found] == ["5 pieces that came as single segments joined to the lines that they go on"]
