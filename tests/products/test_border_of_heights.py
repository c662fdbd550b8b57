"""Images beside the border of the grid that joins their heights with those of the terrain (fault 1)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin
from tools.geoid import UNDULATION, write_geoid
from tools.line_strip import Strip

STRIP = Strip()
#: What lies this far east of the middle of the image has no undulation, metres; terrain ends ten metres before.
EAST = 40.0
#: In a process of its own: grids that were looked for once are remembered.
LOOK = """
import sys, pyproj
from pathlib import Path
folder = Path(sys.argv[1])
pyproj.datadir.append_data_dir(str(folder))
from photoplan.io.project.file import load_project
from photoplan.plan.footprint import footprint
from photoplan.project.cameras import camera_without_pixels, ground_of
for name in sys.argv[2:]:
    project = load_project(folder / (name + ".toml"))
    camera, ground = camera_without_pixels(project, "strip"), ground_of(project)
    print(footprint(camera, ground.bare, ground.bounds).bounds)
camera = camera_without_pixels(load_project(folder / "own.toml"), "strip")
low, high = camera.vantage.floor, float(camera.vantage.point[2])
print([low, high], (camera.rays([[300.0, 0.0], [300.0, 599.0]], 453.0)[0] > 0).all(axis=1).tolist())
"""


def test_fault_01_what_lies_beyond_the_terrain_needs_no_undulation(tmp_path: Path) -> None:
    X, Y = STRIP.origin
    write_geoid(tmp_path, STRIP.crs, (X + EAST, Y), ends_there=True)
    text = STRIP.write(tmp_path, 500.0).read_text()
    stated = 'height = 500.0\nheight_system = "ellipsoidal"\n'
    assert stated in text
    corner = from_origin(X - 90, Y + 60, 2, 2)
    profile = {"driver": "GTiff", "width": 60, "height": 60, "count": 1, "dtype": "float32", "crs": STRIP.crs}
    systems = {"ellipsoid": "ellipsoidal", "geoid": "EPSG:5773", "own": "EPSG:5773"}
    for name, system in systems.items():
        with rasterio.open(tmp_path / f"{name}.tif", "w", transform=corner, **profile) as file:
            height = 500.0 if system == "ellipsoidal" else 500.0 - UNDULATION
            file.write(np.full((1, 60, 60), height, np.float32))
        orientation = f'[orientation]\nheight_system = "{system}"\n' if name == "own" else ""
        own = f'file = "{name}.tif"\nheight_system = "{system}"\n{orientation}'
        (tmp_path / f"{name}.toml").write_text(text.replace(stated, own))
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LOOK, str(tmp_path), "ellipsoid", "geoid"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stderr
    print(run.stdout)
    ellipsoid, geoid, own = run.stdout.splitlines()
    assert geoid == ellipsoid
    west, south, east, north = eval(ellipsoid)
    assert (west, east) == (X - 90, X + 30) and Y - 70 < south < Y - 50 < Y + 50 < north < Y + 60
    high = float(own.split()[1].rstrip("]"))
    assert abs(high - (STRIP.flying - UNDULATION - 1.0)) < 1e-3
    # Rays end where heights are not known: the one in the east has no place.
    assert own == f"[-500.0, {high}] [True, False]"
