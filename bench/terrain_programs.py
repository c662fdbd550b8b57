"""Programs that make a terrain surface of measured points, each as one command, and heights of what they made."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from programs import Missing
from scipy.ndimage import map_coordinates

HERE = Path(__file__).resolve().parent
#: Distance from points to which v.surf.rst is asked for heights, metres.
REACH = 15.0
Heights = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class Case:
    """Measurements on which surfaces are built, and places at which they are compared."""

    name: str
    folder: Path
    inputs: tuple[Path, ...]
    """Points as CSV with x, y, z; lines as GeoPackage."""
    held: Path
    """CSV with x, y, z of the places."""
    crs: str
    bounds: tuple[float, float, float, float]
    """xmin, ymin, xmax, ymax of the points."""
    line_points: Path | None = None
    """Vertices of lines as CSV, for programs that know no lines."""


@dataclass(frozen=True)
class Surface:
    """A program: how it is called, and the heights that came out."""

    name: str
    command: Callable[[Case, Path], list[str]]
    """Arguments for a case and an empty folder."""
    heights: Callable[[Case, Path], Heights]
    """Heights and standard deviations at the places of the case; NaN: none."""


def photoplan() -> Surface:
    """This checkout's `dtm build`, on two cores; `dtm sample` afterwards is not measured."""
    script = Path(sys.executable).with_name("photoplan")
    if not script.exists():
        raise Missing(f"photoplan: {script} is not there; pip install . first")

    def command(case: Case, folder: Path) -> list[str]:
        call = [script, "dtm", "build", *case.inputs, "-o", folder / "model.gpkg", "--crs", case.crs]
        return [str(part) for part in [*call, "--workers", 2, "--no-report", "--quiet"]]

    def heights(case: Case, folder: Path) -> Heights:
        out = folder / "held.csv"
        call = [script, "dtm", "sample", folder / "model.gpkg", case.held, "--output", out, "-q"]
        subprocess.run([str(part) for part in call], check=True, stdout=subprocess.DEVNULL)
        with out.open(newline="") as file:
            rows = [(row["height"] or "nan", row["sigma"] or "nan") for row in csv.DictReader(file)]
        values = np.array(rows, float)
        return values[:, 0], values[:, 1]

    return Surface("photoplan", command, heights)


def figures_of(folder: Path) -> dict:
    """What photoplan says of a model: its run record."""
    record: dict = json.loads((folder / "model.run.json").read_text())
    return record


def tin() -> Surface:
    """A constrained triangulation, which takes every measurement for exact."""

    def command(case: Case, folder: Path) -> list[str]:
        inputs = [str(path) for path in case.inputs]
        return [sys.executable, str(HERE / "terrain_tin.py"), str(case.held), str(folder / "tin.npy"), *inputs]

    def heights(case: Case, folder: Path) -> Heights:
        found = np.load(folder / "tin.npy")
        return found, np.full(len(found), np.nan)

    return Surface("constrained TIN", command, heights)


def rst(width: float) -> Surface:
    """GRASS's v.surf.rst (regularised spline with tension) with its defaults, two threads, in a temporary location.

    It knows no lines: their vertices are points to it.
    """
    script = shutil.which("grass")
    if script is None:
        raise Missing("v.surf.rst: grass not found; on Debian it is in the package grass-core")

    def command(case: Case, folder: Path) -> list[str]:
        points = [case.inputs[0], *([case.line_points] if case.line_points else [])]
        first, *more = (f"'{path}'" for path in points)
        xmin, ymin, xmax, ymax = case.bounds
        steps = [
            "set -e",
            f"(cat {first}; for f in {' '.join(more)}; do tail -n +2 $f; done) > '{folder / 'all.csv'}'",
            f"v.in.ascii -z -t --q input='{folder / 'all.csv'}' output=p format=point separator=comma skip=1 z=3",
            f"g.region -a w={xmin} s={ymin} e={xmax} n={ymax} res={width}",
            # Only near points, as photoplan does.
            "v.to.rast --q input=p type=point output=there use=val value=1",
            "r.grow.distance --q input=there distance=away",
            f"r.mapcalc --q expression='near = if(away < {REACH}, 1, null())'",
            "v.surf.rst --q input=p elevation=e mask=near nprocs=2",
            f"r.out.gdal --q -c input=e output='{folder / 'rst.tif'}' format=GTiff type=Float32",
        ]
        (folder / "rst.sh").write_text("\n".join(steps) + "\n")
        return [script, "--tmp-location", "XY", "--exec", "sh", str(folder / "rst.sh")]

    def heights(case: Case, folder: Path) -> Heights:
        XY = np.loadtxt(case.held, delimiter=",", skiprows=1)[:, :2]
        with rasterio.open(folder / "rst.tif") as data:
            grid, inverse = data.read(1, masked=True).filled(np.nan), ~data.transform
        column, row = inverse * (XY[:, 0], XY[:, 1])
        found = map_coordinates(grid, [row - 0.5, column - 0.5], order=1, mode="nearest")
        return found, np.full(len(found), np.nan)

    return Surface("v.surf.rst", command, heights)
