"""Terrain from measured points: photoplan, a constrained TIN and GRASS's v.surf.rst on the same points.

    python bench/terrain.py [--quick] [--large] [--json FILE]

Time, peak memory, and the error at places that were held out. Whole processes are measured, reading of the files
included; photoplan and v.surf.rst may use two cores. Real survey points with breaklines (a tenth held out), and
analytic terrain with known noise, where the error is that of the surface itself. Ten million points (`--large`) take
a quarter of an hour.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import shapely
from numpy.typing import NDArray
from prepare import CHECKOUT, WORK
from programs import Missing
from terrain_programs import Case, Surface, figures_of, photoplan, rst, tin

from photoplan.io.terrain.files import read_measured

HERE = Path(__file__).resolve().parent
MIB = 2**20
FOLDER = WORK / "terrain"
SURVEY = CHECKOUT.parent / "shared" / "data" / "m3_road_survey" / "M3_Terrain.mm.xml"

#: One million points: seconds and MiB at most; ten million: times that of one million at most.
SECONDS_TARGET, MEMORY_TARGET, RATIO_TARGET = 120.0, 2048.0, 12.0
#: Held-out points this close to a breakline are looked at by themselves, metres.
NEAR = 2.0
#: Noise of the analytic points, metres; their spacing; places at which the surface is compared.
NOISE, SPACING, PLACES = 0.10, 2.0, 20_000
#: v.surf.rst gets no more points than these: it then takes a minute and a half already.
MOST_RST = 100_000


def relief(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Analytic terrain: hills, a valley, small forms; metres."""
    hills = 40 * np.sin(X / 610) * np.cos(Y / 470) + 12 * np.sin((X + 0.6 * Y) / 170)
    small = 1.5 * np.sin(X / 31) * np.sin(Y / 37) + 0.3 * np.cos((X - Y) / 11)
    valley = -25 * np.exp(-(((X - 0.5 * Y) / 220) ** 2))
    return 300 + hills + small + valley


def analytic(points: int) -> Case:
    """Points with noise on the analytic terrain; places are held out of nothing, their heights are the truth."""
    folder = FOLDER / f"analytic_{points}"
    rng = np.random.default_rng(3)
    side = SPACING * np.sqrt(points)
    origin = np.array([500_000.0, 5_000_000.0])
    case = Case(
        f"analytic terrain, {points} points, noise {NOISE} m",
        folder,
        (folder / "points.csv",),
        folder / "held.csv",
        "EPSG:32633",
        (*origin, *(origin + side)),
    )
    if case.held.exists():
        return case
    folder.mkdir(parents=True, exist_ok=True)
    with case.inputs[0].open("w") as file:
        file.write("x,y,z\n")
        for start in range(0, points, 1_000_000):
            xy = rng.uniform(0, side, (min(1_000_000, points - start), 2))
            z = relief(*xy.T) + rng.normal(0, NOISE, len(xy))
            np.savetxt(file, np.column_stack([xy + origin, z]), fmt="%.3f", delimiter=",")
    xy = rng.uniform(0.01 * side, 0.99 * side, (PLACES, 2))
    _write(case.held, np.column_stack([xy + origin, relief(*xy.T)]))
    return case


def survey(seed: int = 0) -> Case:
    """Real points and breaklines, a tenth of the points held out."""
    folder = FOLDER / "survey"
    folder.mkdir(parents=True, exist_ok=True)
    measured = read_measured([SURVEY])
    xyz = np.concatenate([group.xyz for group in measured.points])
    order = np.random.default_rng(seed).permutation(len(xyz))
    tenth = len(xyz) // 10
    case = Case(
        f"M3 road survey, {len(xyz) - tenth} points and {len(measured.lines)} breaklines, {tenth} points held out",
        folder,
        (folder / "points.csv", folder / "lines.gpkg"),
        folder / "held.csv",
        str(measured.crs),
        (*(xyz[:, :2].min(axis=0)), *(xyz[:, :2].max(axis=0))),
        folder / "line_points.csv",
    )
    _write(case.held, xyz[np.sort(order[:tenth])])
    _write(case.inputs[0], xyz[np.sort(order[tenth:])])
    assert case.line_points is not None
    _write(case.line_points, np.concatenate([line.xyz for line in measured.lines]))
    case.inputs[1].unlink(missing_ok=True)
    shapes = shapely.to_wkb([shapely.LineString(line.xyz) for line in measured.lines], flavor="iso")
    kinds = np.array([line.kind for line in measured.lines], object)
    pyogrio.raw.write(
        case.inputs[1], np.array(shapes, object), [kinds], ["kind"], geometry_type="LineString Z", crs=case.crs
    )
    return case


def _write(path: Path, xyz: NDArray[np.float64]) -> None:
    np.savetxt(path, xyz, fmt="%.4f", delimiter=",", header="x,y,z", comments="")


def measure(program: Surface, case: Case) -> dict:
    """One run into an empty folder: cost (see measure.py) and errors."""
    folder = case.folder / program.name.replace(" ", "_")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    print(f"  {program.name} …", file=sys.stderr)
    command = [sys.executable, HERE / "measure.py", *program.command(case, folder)]
    cost: dict = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    if cost["code"] != 0:
        return {"failed": f"ended with code {cost['code']}: {cost['stderr'].strip()[-300:]}"}
    del cost["stderr"], cost["code"]
    heights, sigmas = program.heights(case, folder)
    return cost | errors(case, heights, sigmas)


def errors(case: Case, heights: NDArray[np.float64], sigmas: NDArray[np.float64]) -> dict:
    """Differences at the places held out, for all and for those near breaklines."""
    held = np.loadtxt(case.held, delimiter=",", skiprows=1)
    e = heights - held[:, 2]
    known = np.isfinite(e)
    out = {"rms": _rms(e), "missing": int((~known).sum()), "rms_near": None, "sigma": _rms(sigmas)}
    if len(case.inputs) > 1:
        lines = shapely.from_wkb(pyogrio.raw.read(case.inputs[1])[2])
        near = np.zeros(len(held), bool)
        tree = shapely.STRtree(lines)
        near[tree.query(shapely.points(held[:, :2]), predicate="dwithin", distance=NEAR)[0]] = True
        out |= {"rms_near": _rms(e[near]), "near": int(near.sum())}
    return out


def _rms(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else None


def compare(case: Case, makers: list[Callable[[float], Surface]]) -> dict[str, dict]:
    """All programs on one case; the first is ours and says the grid width of the others."""
    found: dict[str, dict] = {}
    width = 1.0
    for make in makers:
        try:
            program = make(width)
        except Missing as reason:
            print(f"left out: {reason}")
            continue
        found[program.name] = measure(program, case)
        if program.name == "photoplan" and "failed" not in found["photoplan"]:
            record = figures_of(case.folder / "photoplan")
            found["photoplan"]["figures"] = {k: record.get(k) for k in ("noise", "spread", "grid_widths")}
            width = min(float(w) for w in record["grid_widths"])
    show(case, found)
    return found


def show(case: Case, found: dict[str, dict]) -> None:
    """The rows of one case."""
    print(f"\n{case.name}")
    print(
        f"  {'':18}{'wall s':>8}{'CPU s':>8}{'wall / ours':>13}{'peak MiB':>10}"
        f"{'error m':>9}{'near lines':>12}{'no height':>11}"
    )
    ours = found.get("photoplan", {})
    for name, row in found.items():
        if "failed" in row:
            print(f"  {name:18}{row['failed']}")
            continue
        ratio = f"{row['wall'] / ours['wall']:.2f}" if "wall" in ours else ""
        near = "" if row["rms_near"] is None else f"{row['rms_near']:.3f}"
        print(
            f"  {name:18}{row['wall']:8.1f}{row['cpu']:8.1f}{ratio:>13}{row['memory'] / MIB:10.0f}"
            f"{row['rms'] or np.nan:9.4f}{near:>12}{row['missing']:11}"
        )
    if ours.get("sigma"):
        print(f"  standard deviation that photoplan states: {ours['sigma']:.4f} m (root mean square)")


def verdict(value: float, most: float, what: str) -> None:
    """One line on a figure that was asked for."""
    print(f"  {what} {value:.1f}, to reach ≤ {most:g}: {'reached' if value <= most else 'NOT REACHED'}")


def report_terrain(quick: bool = False, large: bool = False) -> dict:
    """All rows; `quick` leaves the million points out, `large` adds ten million."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    ours = lambda width: photoplan()  # noqa: E731
    others: list[Callable[[float], Surface]] = [lambda width: tin(), rst]
    print("\nTerrain from measured points, two cores, whole processes")
    found: dict[str, dict] = {}
    if SURVEY.exists():
        # The first run after a change compiles the kernels; it is not counted.
        case = survey()
        measure(photoplan(), case)
        found["survey"] = compare(case, [ours, *others])
    else:
        print("left out: the road survey (the folder `shared` with test data is not beside the checkout)")
    found["analytic 100 000"] = compare(analytic(MOST_RST), [ours, *others])
    if quick:
        return found
    # A TIN of a million points is a matter of seconds; v.surf.rst would take a quarter of an hour.
    found["analytic 1 000 000"] = million = compare(analytic(1_000_000), [ours, others[0]])
    if "wall" in million["photoplan"]:
        verdict(million["photoplan"]["wall"], SECONDS_TARGET, "one million points: seconds")
        verdict(million["photoplan"]["memory"] / MIB, MEMORY_TARGET, "one million points: peak MiB")
    if large:
        case = replace(analytic(10_000_000), name="analytic terrain, 10000000 points")
        found["analytic 10 000 000"] = ten = compare(case, [ours])
        if "wall" in ten["photoplan"] and "wall" in million["photoplan"]:
            ratio = ten["photoplan"]["wall"] / million["photoplan"]["wall"]
            verdict(ratio, RATIO_TARGET, "ten million points: times the time of one million")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="without the million points")
    parser.add_argument("--large", action="store_true", help="with ten million points (a quarter of an hour)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    options = parser.parse_args()
    found = report_terrain(options.quick, options.large)
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
