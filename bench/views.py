"""Perspective views: the ground of every pixel and a picture, beside VTK with the same terrain, camera and size.

    python bench/views.py [--quick] [--repeat N] [--json FILE]

1024 × 763 pixels over 693 × 720 cells, 2000 × 1500 over 4000 × 4000 cells of rough terrain made here; flat earth. Each
run is a process of its own, of which the seconds after the imports are counted (reading the terrain, loading kernels
and drivers included), and the peak memory of the whole. VTK makes a mesh of the posts, a picture and the depth buffer;
photoplan the nine bands of the matrix and a picture of tints and shades, one ray a pixel, tile by tile. The height
error is that of the point of each pixel over the bilinear posts below it. Without pyvista (installed into an
environment of its own when first needed) VTK is left out.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from prepare import WORK
from programs import Missing
from rasterio.transform import from_origin
from scipy.ndimage import map_coordinates

HERE = Path(__file__).resolve().parent
MIB = 2**20
PYVISTA = WORK / "pyvista-venv"
CRS, LEFT, TOP = "EPSG:32632", 500_000.0, 5_200_000.0
#: Most of VTK's time and memory, and height error of the matrix, metres.
TIME_TARGET, MEMORY_TARGET, HEIGHT_TARGET = 0.5, 0.25, 0.05


@dataclass(frozen=True)
class Case:
    """A view: posts (rows, columns), mesh width and roughness in metres, picture size."""

    name: str
    posts: tuple[int, int]
    mesh: float
    rough: float
    size: tuple[int, int]
    runs: int

    @property
    def folder(self) -> Path:
        return WORK / "views" / self.name


CASES = (
    Case("small", (721, 694), 25.0, 300.0, (1024, 763), 3),
    Case("large", (4001, 4001), 10.0, 500.0, (2000, 1500), 1),
)


def rough_posts(case: Case) -> NDArray[np.float32]:
    """Terrain whose amplitudes fall with the frequency to the power of 2.2."""
    rng, n = np.random.default_rng(1), max(case.posts)
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None])
    frequency[0, 0] = 1.0
    waves = rng.normal(size=frequency.shape) + 1j * rng.normal(size=frequency.shape)
    heights = np.fft.irfft2(waves * frequency**-2.2, (n, n))
    heights = 1500 + case.rough * (heights - heights.mean()) / heights.std()
    return heights[: case.posts[0], : case.posts[1]].astype(np.float32)


def prepare_case(case: Case) -> None:
    """The terrain as GeoTIFF and as plain numbers, and the camera: from a corner to the middle, 300 m above ground."""
    case.folder.mkdir(parents=True, exist_ok=True)
    posts = rough_posts(case)
    rows, cols = posts.shape
    place = from_origin(LEFT, TOP, case.mesh, case.mesh)
    profile = {"driver": "GTiff", "width": cols, "height": rows, "count": 1, "dtype": "float32", "crs": CRS}
    profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512}
    with rasterio.open(case.folder / "terrain.tif", "w", transform=place, **profile) as f:
        f.write(posts, 1)
    np.save(case.folder / "posts.npy", posts)
    row, col = int(0.9 * rows), int(0.1 * cols)
    corner = (LEFT + case.mesh / 2, TOP - case.mesh / 2)
    told = {
        "posts": str(case.folder / "posts.npy"),
        "terrain": str(case.folder / "terrain.tif"),
        "corner": corner,
        "mesh": case.mesh,
        "size": case.size,
        "center": [corner[0] + col * case.mesh, corner[1] - row * case.mesh, float(posts[row, col]) + 300.0],
        "azimuth": 45.0,
        "pitch": -8.0,
        "field_of_view": 60.0,
        "near": 50.0,
        "far": 1.5 * case.mesh * max(case.posts),
    }
    (case.folder / "case.json").write_text(json.dumps(told))


def install_pyvista() -> Path:
    """Python with pyvista, in an environment of its own."""
    python = PYVISTA / "bin" / "python"
    if not python.exists():
        print("installing pyvista into an environment of its own …", file=sys.stderr)
        try:
            venv.create(PYVISTA, with_pip=True, clear=True)
            subprocess.run([PYVISTA / "bin" / "pip", "install", "--quiet", "pyvista"], check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise Missing(f"VTK: pyvista could not be installed ({error})") from None
    return python


def run_once(name: str, command: list[object], case: Case) -> dict[str, float]:
    """Seconds of wall and processor after the imports, and peak memory."""
    out = case.folder / name
    out.mkdir(exist_ok=True)
    words = [sys.executable, HERE / "measure.py", *command, case.folder / "case.json", out]
    cost = json.loads(subprocess.run([*map(str, words)], check=True, capture_output=True, text=True).stdout)
    if cost["code"] != 0:
        raise Missing(f"{name}: ended with code {cost['code']}: {cost['stderr'].strip()[-300:]}")
    steps = json.loads((out / "times.json").read_text())
    told = {"wall": sum(s[0] for s in steps.values()), "cpu": sum(s[1] for s in steps.values())}
    return told | {"memory": cost["memory"], "whole": cost["cpu"], "steps": steps}


def height_errors(case: Case, XYZ: NDArray[np.float64]) -> dict[str, float]:
    """Of points (3, …) above the bilinear posts below them, metres."""
    posts = np.load(case.folder / "posts.npy").astype(float)
    X, Y, Z = XYZ.reshape(3, -1)[:, np.isfinite(XYZ[2]).ravel()]
    at = [(TOP - case.mesh / 2 - Y) / case.mesh, (X - LEFT - case.mesh / 2) / case.mesh]
    error = np.abs(Z - map_coordinates(posts, at, order=1, mode="nearest"))
    return {"median": float(np.median(error)), "p99": float(np.percentile(error, 99)), "worst": float(error.max())}


def points_of_depth(case: Case) -> NDArray[np.float64]:
    """Points of the pixels of VTK's depth buffer, (3, height, width)."""
    told, depth = json.loads((case.folder / "case.json").read_text()), np.load(case.folder / "VTK" / "depth.npy")
    (width, height), focal = case.size, case.size[0] / 2 / np.tan(np.radians(told["field_of_view"]) / 2)
    v, u = np.mgrid[:height, :width]
    azimuth, pitch = np.radians(told["azimuth"]), np.radians(told["pitch"])
    axis = np.array([np.sin(azimuth) * np.cos(pitch), np.cos(azimuth) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    up = np.cross(right, axis)
    x, y = (u - (width - 1) / 2) / focal, ((height - 1) / 2 - v) / focal
    way = axis[:, None, None] + x * right[:, None, None] + y * up[:, None, None]
    return np.array(told["center"])[:, None, None] + depth * way


def report_views(quick: bool, repeat: int = 3) -> list[dict]:
    """All rows, printed and as values."""
    rows = []
    print("\nPerspective views: ground of every pixel and a picture")
    ours = [sys.executable, HERE / "view_photoplan.py"]
    for case in CASES[:1] if quick else CASES:
        prepare_case(case)
        programs: dict[str, list[object]] = {"photoplan": ours}
        try:
            programs["VTK"] = [install_pyvista(), HERE / "view_vtk.py"]
            costs: dict[str, list[dict]] = {name: [] for name in programs}
            run_once("photoplan", ours, case)
            for _ in range(min(repeat, case.runs)):
                for name, command in programs.items():
                    costs[name].append(run_once(name, command, case))
        except Missing as reason:
            print(f"left out: {reason}")
            costs = {"photoplan": [run_once("photoplan", ours, case)]}
        row: dict = {"case": case.name, "runs": costs}
        errors = {"photoplan": height_errors(case, np.load(case.folder / "photoplan" / "matrix.npy"))}
        if "VTK" in costs:
            errors["VTK"] = height_errors(case, points_of_depth(case))
        (rows_, cols), (width, height) = case.posts, case.size
        print(f"  {width} × {height} pixels over {cols - 1} × {rows_ - 1} cells")
        middle = {
            n: {k: statistics.median(c[k] for c in cost) for k in ("wall", "cpu", "whole", "memory")}
            for n, cost in costs.items()
        }
        for name, m in middle.items():
            e, steps = errors[name], costs[name][-1]["steps"]
            parts = ", ".join(f"{what} {s[0]:.2f}" for what, s in steps.items())
            print(
                f"    {name:10} {m['wall']:6.2f} s ({parts}), {m['cpu']:.2f} CPU s, whole process {m['whole']:.2f}, "
                f"{m['memory'] / MIB:.0f} MiB\n{'':15}height error {e['median']:.2g} m in the median, {e['p99']:.2g} m "
                f"(99 %), {e['worst']:.2g} m at worst"
            )
        if "VTK" in middle:
            part = {k: middle["photoplan"][k] / middle["VTK"][k] for k in ("wall", "cpu", "whole", "memory")}
            print(
                f"    ours / VTK: wall {part['wall']:.2f}, CPU {part['cpu']:.2f} (asked {TIME_TARGET}), whole process "
                f"{part['whole']:.2f}, memory "
                f"{part['memory']:.2f} (asked {MEMORY_TARGET} at the larger size)"
            )
        print(f"    height error of the matrix {errors['photoplan']['worst']:.2g} m (asked {HEIGHT_TARGET})")
        rows.append(row | {"errors": errors, "median": middle})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the smaller size only")
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="runs of each program [3]")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    WORK.mkdir(exist_ok=True)
    found = report_views(options.quick, options.repeat)
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
