"""Positions by hand of 28 real mid-side marks: ``python draw_usgs_marks.py FOLDER OUT.jpg``.

FOLDER holds the crops of film_usgs_hipp (`ee/block/T.jpg` …); the positions are those of the tests.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from photoplan.geometry.grid import Window
from photoplan.project.camera_marks import ScanImage

POSITIONS = Path(__file__).resolve().parents[2] / "tests" / "real" / "usgs_marks" / "positions.csv"
HALF = {"nagap_triangle": 150, "nagap_notch": 105}
"""Pixels shown beside a position that its surroundings define."""


def draw_usgs_marks(folder: Path) -> Figure:
    """One panel for each crop: what lies around the position, grey lines from the border towards it."""
    rows = csv.DictReader(line for line in POSITIONS.read_text(encoding="utf-8").splitlines() if line[0] != "#")
    fig = Figure(figsize=(9.1, 5.6), dpi=130, layout="constrained")
    for axes, row in zip(fig.subplots(4, 7, gridspec_kw={"wspace": 0, "hspace": 0}).T.ravel(), rows, strict=True):
        scan = ScanImage(folder / row["crop"])
        grey = scan.grey(Window(0, 0, *scan.size))
        half = HALF.get(row["family"], 45)
        x, y = float(row["x"]), float(row["y"])
        axes.set_facecolor("#9ebdde")
        axes.imshow(grey, cmap="gray", interpolation="nearest")
        axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half), xticks=[], yticks=[])
        for along in (np.array([3.0, half]), np.array([-3.0, -half])):
            axes.plot(x + along, [y, y], color="#ee3311", lw=0.7)
            axes.plot([x, x], y + along, color="#ee3311", lw=0.7)
        axes.set_title(f"{row['crop']}  {x:g}, {y:g}", fontsize=5.5)
    return fig


if __name__ == "__main__":
    draw_usgs_marks(Path(sys.argv[1])).savefig(sys.argv[2], pil_kwargs={"quality": 82})
