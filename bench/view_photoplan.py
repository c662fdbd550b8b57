"""The view of bench/views.py by this checkout's parts: the ground of every pixel and a picture, tile by tile on two
threads. All nine bands of the matrix are made; places are kept, to be compared.

    python view_photoplan.py CASE.json OUT

See view_vtk.py for both.
"""

import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from photoplan.geometry.grid import Window
from photoplan.plan.footprint import Tile
from photoplan.products.view import make
from photoplan.products.view import make as job
from photoplan.products.view.content import ViewScene
from photoplan.requests.view import CameraRequest

#: Side of the tiles, pixels.
TILE = 128


def main(case, out):
    told = json.loads(case.read_text())
    marks = [(time.perf_counter(), time.process_time())]
    x, y, z = told["center"]
    camera = CameraRequest(position=(x, y), altitude=z, azimuth=told["azimuth"], pitch=told["pitch"],
                           field_of_view=told["field_of_view"], size=tuple(told["size"]), curvature="none")  # fmt: skip
    address = make.plan_view(make.ViewRequest(Path(told["terrain"]), camera)).address
    view = address.open()
    marks.append((time.perf_counter(), time.process_time()))
    width, height = view.target.bundle.size
    places, picture = np.full((3, height, width), np.nan), np.empty((3, height, width), np.uint8)

    def tile(window):
        # With a pixel more all round, as pictures need it; seen once for both.
        around = Window(window.col - 1, window.row - 1, window.width + 2, window.height + 2) & view.target.window
        seen = view.surface.look(view.target, around)
        found = job.matrix_bands(view.target, seen.part(*window.slices(around)))
        if found is not None:
            places[:, *window.slices(view.target.window)] = found[0][:3]
        scene = ViewScene.of(view.target, Tile(0, window), lambda asked: seen, view.surface, "bicubic")
        picture[:, *window.slices(view.target.window)] = job.colours_of(scene, view, address.look)

    with ThreadPoolExecutor(2) as pool:
        [*pool.map(tile, view.target.window.tiles(TILE))]
        marks.append((time.perf_counter(), time.process_time()))
    np.save(out / "matrix.npy", places)
    np.save(out / "picture.npy", np.moveaxis(picture, 0, -1))
    steps = {
        name: [b - a for a, b in zip(marks[k], marks[k + 1])] for k, name in enumerate(("plan", "matrix and picture"))
    }
    (out / "times.json").write_text(json.dumps(steps))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
