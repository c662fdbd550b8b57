"""The view of bench/views.py by VTK: a mesh of the posts, a picture, and the depth buffer. Run in an environment that
has pyvista; it knows nothing of photoplan.

    python view_vtk.py CASE.json OUT

CASE holds posts (.npy), corner, mesh, size, center, azimuth, pitch, field of view; OUT gets depth.npy, picture.npy.
Seconds go to times.json.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import pyvista as pv


def main(case, out):
    case = json.loads(case.read_text())
    marks = [(time.perf_counter(), time.process_time())]
    posts = np.load(case["posts"])
    rows, cols = posts.shape
    x = case["corner"][0] + case["mesh"] * np.arange(cols)
    y = case["corner"][1] - case["mesh"] * np.arange(rows)
    # Single precision is what the card gets: heights refer to the point of view.
    center = np.array(case["center"])
    grid = pv.StructuredGrid(*np.meshgrid(x - center[0], y - center[1]), posts.astype(float) - center[2])
    grid["height"] = posts.ravel(order="F")
    plotter = pv.Plotter(off_screen=True, window_size=case["size"])
    plotter.disable_anti_aliasing()
    plotter.add_mesh(grid, scalars="height", cmap="gray", show_scalar_bar=False)
    azimuth, pitch = np.radians(case["azimuth"]), np.radians(case["pitch"])
    way = np.array([np.sin(azimuth) * np.cos(pitch), np.cos(azimuth) * np.cos(pitch), np.sin(pitch)])
    camera = plotter.camera
    camera.position, camera.focal_point, camera.up = (0, 0, 0), tuple(1000 * way), (0, 0, 1)
    width, height = case["size"]
    camera.view_angle = 2 * np.degrees(np.arctan(np.tan(np.radians(case["field_of_view"]) / 2) * height / width))
    camera.clipping_range = (case["near"], case["far"])
    plotter.show(auto_close=False)
    picture = plotter.screenshot(None, return_img=True)
    marks.append((time.perf_counter(), time.process_time()))
    # Distance along the axis; NaN: sky.
    depth = -plotter.get_image_depth()
    marks.append((time.perf_counter(), time.process_time()))
    np.save(out / "depth.npy", depth)
    np.save(out / "picture.npy", picture)
    steps = {
        name: [b - a for a, b in zip(marks[k], marks[k + 1])] for k, name in enumerate(("mesh and picture", "depth"))
    }
    (out / "times.json").write_text(json.dumps(steps))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
