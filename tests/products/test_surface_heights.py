"""Heights of `surface` and `monoplot` are those of the system of the orientation, whatever the cameras work in."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tools.facet_scene import GROUND, HEIGHT, write_scene
from tools.geoid import UNDULATION, write_geoid
from tools.small_block import CRS, X0, Y0, write_terrain

#: In a process of its own: grids that were looked for once are remembered. A wall that looks up is a map.
MADE = """
import sys, numpy, pyproj, rasterio
pyproj.datadir.append_data_dir(".")
from photoplan.io.project.file import load_project
from photoplan.products.monoplot import MonoplotRequest, monoplot_file
from photoplan.products.surface.plan import _start
from photoplan.products.surface.plan import plan_surface
from photoplan.products.surface.run import make_surface
from photoplan.requests.surface import SurfaceSettings
from pathlib import Path
project, (x, y, z) = load_project("project.toml"), map(float, sys.argv[1:])
plan = plan_surface(project, SurfaceSettings(3.0, bounds=(x - 9, y - 9, x + 9, y + 9), start=str(z + 1), reach=8.0))
with rasterio.open(make_surface(plan, "map").path) as file:
    print(numpy.nanmean(file.read(1)), plan.gap.median)
wall = SurfaceSettings(
    3.0, target=f"wall:{x},{y},{z},180,90", bounds=(-9, -9, 9, 9), reach=8.0, points=(Path("wall.ply"),)
)
plan = plan_surface(project, wall)
make_surface(plan, "wall")
points = Path("wall.ply").read_bytes().partition(b"end_header\\n")[2]
points = numpy.frombuffer(points, [("xyz", "<f8", 3), ("sigma", "<f4"), ("grey", "<f4")])
print(points["xyz"][:, 2].mean(), plan.frame.origin[2])
Path("points.csv").write_text("x,y\\n60,45\\n")
found = monoplot_file(MonoplotRequest(Path("project.toml"), project.images[0].name, Path("points.csv"), Path("at.csv")))
print(Path("at.csv").read_text().splitlines()[1].split(",")[4], found.height_system == "EPSG:5773")
project = load_project("ellipsoidal.toml")
plan = plan_surface(project, SurfaceSettings(3.0, bounds=(x - 9, y - 9, x + 9, y + 9), start="start.tif", reach=8.0))
start = _start(plan.address, "start.tif", plan.begun, project.crs)
print(start(numpy.array([[[x, y]]]))[0, 0], plan.gap.median)
"""


@pytest.mark.slow
def test_heights_over_a_curved_earth_are_in_the_system_of_the_orientation(tmp_path: Path) -> None:
    write_geoid(tmp_path, CRS, (X0, Y0))
    scene = write_scene(tmp_path, 3)
    text = scene.path.read_text().replace('height_system = "same"', 'height_system = "EPSG:5773"')
    scene.path.write_text(text.replace("[orientation]", '[orientation]\nearth_curvature = "strict"'))
    # Cameras and terrain above the ellipsoid, with a start above the geoid, which its file states.
    other = re.sub(r"(center = .*), [0-9.]+]", rf"\1, {GROUND + HEIGHT + UNDULATION}]", text)
    other = other.replace(f"height = {GROUND}", f"height = {GROUND + UNDULATION}").replace("EPSG:5773", "ellipsoidal")
    (tmp_path / "ellipsoidal.toml").write_text(other)
    write_terrain(tmp_path / "start.tif", np.full((60, 64), GROUND), crs=f"{CRS}+5773")
    words = [str(value) for value in (X0, Y0, GROUND)]
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", MADE, *words], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr
    print(run.stdout)
    (over_map, apart), (over_wall, origin), (plotted, system), (begun, beside) = (
        line.split() for line in run.stdout.splitlines()
    )
    # Points of one image, too: level ground.
    assert abs(float(plotted) - GROUND) < 1e-3 and system == "True"
    over_map, apart, over_wall, origin, begun, beside = map(float, (over_map, apart, over_wall, origin, begun, beside))
    x, y = np.meshgrid(X0 + np.linspace(-9, 9, 7), Y0 + np.linspace(-9, 9, 7))
    # The map's scale is 0.9996: eight centimetres of the flying height.
    assert abs(over_map - scene.heights(x, y).mean() + 0.08) < 0.1 and abs(over_wall - over_map) < 0.1
    assert abs(begun - GROUND - UNDULATION) < 0.01 and abs(beside) < 0.01
    assert abs(origin - GROUND - UNDULATION) < 0.01 and apart == 1.0
