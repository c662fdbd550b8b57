"""28 crops with mid-side marks of seven cameras, located by descriptions and by examples, against positions by hand.

The positions were read from enlarged pixels before the program was tried, see `usgs_marks/positions.csv` and the
picture `docs/figures/usgs-marks.jpg`.
"""

from __future__ import annotations

import csv
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter
from tools.thinned import some

from photoplan.cameras.fiducials import MarkExample, MarkPattern
from photoplan.cameras.marks import Mark
from photoplan.geometry.grid import Window
from photoplan.orientation.marks.single import SingleMark, find_mark
from photoplan.project.camera_marks import ScanImage, mark_pattern

HERE = Path(__file__).resolve().parent / "usgs_marks"
LIMIT = 1.5
PIXEL_MM = {"nagap/notch/L.jpg": 0.025 / 1.33}
"""This crop alone has smaller pixels than its three neighbours."""


@dataclass(frozen=True)
class Crop:
    family: str
    file: str
    side: str
    x: float
    y: float

    @property
    def mm_to_pixel(self) -> NDArray[np.float64]:
        return np.diag([1.0, -1.0]) / PIXEL_MM.get(self.file, 0.025)

    def grey(self, shared: Path) -> NDArray[np.float32]:
        scan = ScanImage(shared / "data" / "film_usgs_hipp" / "fiducials" / self.file)
        return scan.grey(Window(0, 0, *scan.size))

    def off(self, found: SingleMark) -> float:
        return math.hypot(found.x - self.x, found.y - self.y)


def crops() -> list[Crop]:
    lines = (HERE / "positions.csv").read_text(encoding="utf-8").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return [Crop(r["family"], r["crop"], r["side"], float(r["x"]), float(r["y"])) for r in rows]


def patterns() -> dict[tuple[str, str], MarkPattern | MarkExample]:
    entries = tomllib.loads((HERE / "marks.toml").read_text(encoding="utf-8"))
    described = TypeAdapter(dict[str, dict[str, Mark]]).validate_python(entries)
    return {
        (family, side): mark_pattern(mark, HERE) for family, marks in described.items() for side, mark in marks.items()
    }


CROPS, PATTERNS = crops(), patterns()


@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_marks_are_located_within_one_and_a_half_pixels(every, shared, capsys):
    crops = CROPS[::every]
    lines, good, wrong, crosses = [], 0, [], []
    for crop in crops:
        found = find_mark(crop.grey(shared), PATTERNS[crop.family, crop.side], crop.mm_to_pixel)
        right = found.accepted and crop.off(found) <= LIMIT
        good += right
        if crop.family == "nagap_arc":
            crosses.append(crop.off(found))
        if found.accepted and not right:
            wrong.append(crop.file)
        lines.append(
            f"{crop.file:22s} {found.x - crop.x:6.2f} {found.y - crop.y:6.2f} px  sigma {found.sigma_x:.2f} "
            f"{found.sigma_y:.2f}  r {found.correlation:.2f}  {found.method:8s} {found.refused or 'accepted'}"
        )
    with capsys.disabled():
        print("\nfound − by hand\n" + "\n".join(lines))
    assert len(CROPS) == 28
    assert good >= (26 if every == 1 else len(crops)), "\n".join(lines)  # measured: 28, the largest difference 1.2 px
    assert not wrong, "\n".join(lines)
    # Where the mark defines its point sharply, the program and the eye agree much better.
    assert crosses and max(crosses) <= 0.3


OTHER = {
    "ee_block": "ee_notch",
    "ee_notch": "nagap_curve",
    "nagap_block": "nagap_triangle",
    "nagap_curve": "nagap_arc",
    "nagap_triangle": "nagap_notch",
    "nagap_arc": "nagap_block",
    "nagap_notch": "ee_block",
}


def one_of_each() -> list[Crop]:
    """A crop of each camera, not always of the same side."""
    families = {family: [crop for crop in CROPS if crop.family == family] for family in OTHER}
    return [crops[k % len(crops)] for k, crops in enumerate(families.values())]


@pytest.mark.parametrize("crops", [one_of_each()[:2], pytest.param(CROPS, marks=pytest.mark.slow)], ids=["two", "all"])
def test_marks_of_another_camera_are_refused(shared, crops):
    taken = []
    for crop in crops:
        found = find_mark(crop.grey(shared), PATTERNS[OTHER[crop.family], crop.side], crop.mm_to_pixel)
        if found.accepted:
            taken.append(f"{OTHER[crop.family]} on {crop.file} at {found.x:.0f}, {found.y:.0f}")
    assert not taken, taken


def example(shared: Path, crop: Crop, box: tuple[int, int, int, int]) -> MarkExample:
    """A mark cut from a crop: columns and rows first to last."""
    c0, r0, c1, r1 = box
    values = crop.grey(shared)[r0:r1, c0:c1]
    return MarkExample("cut", values, (crop.x - c0, crop.y - r0), 0.025)


# Which crop, what of it, which others, and how these look: mirrored and turned against it.
CUT = [
    ("nagap/arc/T.jpg", (820, 215, 970, 365), {"B": (False, 0), "L": (False, 0), "R": (False, 0)}),
    ("ee/block/R.jpg", (0, 278, 170, 498), {"B": (False, 270)}),
    ("nagap/block/T.jpg", (359, 247, 579, 439), {"B": (True, 180)}),
    ("nagap/notch/R.jpg", (0, 15, 157, 235), {"B": (False, 270)}),
]


def turned(degrees: int, mirrored: bool) -> NDArray[np.float64]:
    a = math.radians(degrees)
    rotation = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return rotation @ np.diag([-1.0 if mirrored else 1.0, 1.0])


@pytest.mark.parametrize(("file", "box", "others"), some(CUT, 2))
def test_an_example_of_one_side_finds_the_mark_at_others(shared, file, box, others):
    source = next(crop for crop in CROPS if crop.file == file)
    cut = example(shared, source, box)
    for side, (mirrored, degrees) in others.items():
        crop = next(c for c in CROPS if c.family == source.family and c.side == side)
        found = find_mark(crop.grey(shared), cut, crop.mm_to_pixel @ turned(degrees, mirrored))
        assert found.accepted, (crop.file, found)
        assert crop.off(found) <= LIMIT, (crop.file, found.x - crop.x, found.y - crop.y)


@pytest.mark.parametrize(("side", "mirrored", "degrees"), some([("B", True, 180), ("R", False, 270)], 0))
def test_an_example_of_a_side_with_another_shape_is_refused(shared, side, mirrored, degrees):
    # The upper notch of this camera differs from its lower and right one: it would be placed 6 to 10 px off.
    source = next(crop for crop in CROPS if crop.file == "ee/notch/T.tif")
    crop = next(c for c in CROPS if c.family == "ee_notch" and c.side == side)
    cut = example(shared, source, (389, 51, 609, 250))
    found = find_mark(crop.grey(shared), cut, crop.mm_to_pixel @ turned(degrees, mirrored))
    assert not found.accepted or crop.off(found) <= LIMIT, (crop.file, found.x - crop.x, found.y - crop.y)
