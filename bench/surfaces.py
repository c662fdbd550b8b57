"""Heights from images beside other programs, one run each: OpenCV's StereoSGBM on Middlebury's motorcycle, CARS on
three Pléiades images.

    python bench/surfaces.py [--cars] [--json FILE]

The motorcycle is compared in pixels of disparity at every pixel of the left image that has truth; photoplan's heights
along that image are bilinear between their posts. StereoSGBM: HH mode, 5 × 5, one thread. Pléiades: against the surface
of a third program, s2p, at its posts (0.5 m, 58 % of them filled), bilinear; shifts of the images between each other
are found first, CARS finds its own. Its heights are above a geoid, so spreads are about the median. CARS is installed
into an environment of its own when first needed (`--cars`).
"""

from __future__ import annotations

import argparse
import importlib
import json
import shutil
import subprocess
import sys
import time
import venv
from pathlib import Path

import cv2
import numpy as np
import rasterio
from prepare import CHECKOUT, WORK
from programs import Missing
from scipy.ndimage import map_coordinates

sys.path.insert(0, str(CHECKOUT / "tests"))

DATA = CHECKOUT.parent / "shared" / "data"
MOTORCYCLE, TRIPLET = DATA / "middlebury_motorcycle", DATA / "pleiades_triplet_s2p"
#: Of the left image: camera constant, principal point, pixels; base, metres; by how much the right one's point differs.
FOCAL, POINT, BASE, OFFSET = 994.978, (311.193, 254.877), 0.193001, 31.086
#: Distance of the surface's plane, metres; posts every so many pixels; reach, metres.
PLANE, EVERY, REACH = 2.984934, 2, 1.45
CARS = WORK / "cars-venv"

_PROJECT = """format = 1
crs = "EPSG:32633"
[terrain]
height = 106.3
height_system = "same"
[orientation]
height_system = "same"
"""


def nmad(values):
    """1.4826 times the median distance from the median."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def photoplan(folder, words):
    """CPU seconds of a surface."""
    command = [sys.executable, "-m", "photoplan", "surface", folder / "project.toml", "--output", folder / "products"]
    command += [*words, "--workers", 1, "--no-quicklook", "--overwrite", "-q"]
    measure = [sys.executable, Path(__file__).with_name("measure.py"), *map(str, command)]
    found = json.loads(subprocess.run(measure, stdout=subprocess.PIPE, check=True).stdout)
    if found["code"]:
        raise Missing(f"photoplan: {found['stderr']}")
    return found["cpu"]


def at(path, X, Y):
    """A raster at map points, bilinear, NaN where one of four is missing."""
    with rasterio.open(path) as file:
        col, row = ~file.transform @ (X, Y)
        return map_coordinates(file.read(1).astype(float), [row - 0.5, col - 0.5], order=1, cval=np.nan)


def judged(disparity, truth, sure=None):
    """Part of the pixels with truth that is filled, NMAD, part off by more than one pixel."""
    known = np.isfinite(truth) & np.isfinite(disparity) & (True if sure is None else sure)
    off = (disparity - truth)[known]
    return {
        "filled": float(known.sum() / np.isfinite(truth).sum()),
        "nmad_px": nmad(off),
        "bad1": float((np.abs(off) > 1).mean()),
    }


def motorcycle():
    """Both programs, by their names."""
    folder = WORK / "motorcycle"
    folder.mkdir(parents=True, exist_ok=True)
    images, text = {}, _PROJECT
    for name, x, more in (("left", 0.0, 0.0), ("right", BASE, OFFSET)):
        images[name] = cv2.cvtColor(cv2.imread(str(MOTORCYCLE / f"motorcycle_{name}.png")), cv2.COLOR_BGR2RGB)
        height, width = images[name].shape[:2]
        form = {"driver": "GTiff", "count": 3, "dtype": "uint8", "width": width, "height": height}
        with rasterio.open(folder / f"{name}.tif", "w", **form) as file:
            file.write(images[name].transpose(2, 0, 1))
        text += f'[cameras.{name}]\ntype = "frame"\nsize = [{width}, {height}]\nfocal_px = {FOCAL}\n'
        text += f'principal_point_px = [{POINT[0] + more}, {POINT[1]}]\n[[images]]\nname = "{name}"\n'
        text += f'file = "{name}.tif"\ncamera = "{name}"\ncenter = [{500000 + x:.6f}, 5200000.0, 110.0]\n'
        text += "angles = [0.0, 0.0, 0.0]\n"
    (folder / "project.toml").write_text(text)
    truth = np.load(MOTORCYCLE / "motorcycle_disp.npz")["arr_0"].astype(float)
    pixel = PLANE / FOCAL
    seconds = photoplan(folder, ["--resolution", EVERY * pixel, "--target", f"image:left,{PLANE}", "--reach", REACH])
    y, x = np.mgrid[: truth.shape[0], : truth.shape[1]]
    u, v = (x - POINT[0]) * pixel, (POINT[1] - y) * pixel
    far = FOCAL * BASE / PLANE
    disparity = far * (1 + at(folder / "products" / "surface.tif", u, v) / PLANE) - OFFSET
    sigma = far / PLANE * at(folder / "products" / "surface_sigma.tif", u, v)
    found = {"photoplan": {**judged(disparity, truth), "cpu_s": seconds}}
    for most in (0.3, 0.5, 1.0):
        found[f"photoplan, sigma ≤ {most} px"] = judged(disparity, truth, sigma <= most)
    cv2.setNumThreads(1)
    sgbm = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=64, blockSize=5, P1=8 * 3 * 25, P2=32 * 3 * 25, disp12MaxDiff=1,
        uniquenessRatio=10, speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_HH,
    )  # fmt: skip
    before = time.process_time()
    other = sgbm.compute(images["left"], images["right"]) / 16.0
    seconds = time.process_time() - before
    other[other < 0] = np.nan
    found["StereoSGBM"] = {**judged(other, truth), "cpu_s": seconds}
    both = np.isfinite(other) & (sigma <= 0.3)
    found["StereoSGBM, where photoplan has sigma ≤ 0.3 px"] = judged(other, truth, both)
    return found


def install_cars():
    """CARS' command."""
    script = CARS / "bin" / "cars"
    if not script.exists():
        print("installing CARS into an environment of its own …", file=sys.stderr)
        try:
            venv.create(CARS, with_pip=True, clear=True)
            subprocess.run([CARS / "bin" / "pip", "install", "--quiet", "cars"], check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise Missing(f"CARS could not be installed ({error})") from None
    return script


def cars(folder):
    """The surface of CARS, and its CPU seconds."""
    script, names = install_cars(), ("img_01", "img_02", "img_03")
    files = {name: str(TRIPLET / f"{name}.tif") for name in names}
    settings = {
        "input": {
            "sensors": {n: {"image": f, "geomodel": {"path": f, "model_type": "RPC"}} for n, f in files.items()},
            "pairing": [[names[0], other] for other in names[1:]],
        },
        "orchestrator": {"mode": "sequential"},
        # Ranges of disparity tile by tile: 1.3.0 stops on these images since one is a pixel wider than its margin.
        "surface_modeling": {"applications": {"1": {"dense_matching": {"use_global_disp_range": True}}}},
        "output": {"directory": str(folder), "resolution": 0.5, "epsg": 32631},
    }
    shutil.rmtree(folder, ignore_errors=True)
    folder.with_suffix(".json").write_text(json.dumps(settings))
    measure = [sys.executable, Path(__file__).with_name("measure.py"), script, folder.with_suffix(".json")]
    found = json.loads(subprocess.run(list(map(str, measure)), stdout=subprocess.PIPE, check=True).stdout)
    if found["code"]:
        raise Missing(f"CARS ended with {found['code']}: {found['stderr']}")
    return folder / "dsm" / "dsm.tif", found["cpu"]


def triplet():
    """Both programs against s2p, by their names."""
    folder = WORK / "triplet"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    importlib.import_module("real.test_rpc_ties").brought_together(CHECKOUT.parent / "shared", folder)
    seconds = photoplan(folder, ["--resolution", 1.5, "--reach", 100])
    surfaces = {"photoplan": (folder / "products" / "surface.tif", seconds)}
    try:
        surfaces["CARS"] = cars(folder / "cars")
    except Missing as error:
        print(error, file=sys.stderr)
    return against_s2p(surfaces)


def against_s2p(surfaces):
    """Differences at the posts of s2p's surface, and where all have heights."""
    with rasterio.open(TRIPLET / "s2p_dsm.tif") as file:
        Z = file.read(1).astype(float)
        row, col = np.nonzero(np.isfinite(Z))
        X, Y = file.transform @ (col + 0.5, row + 0.5)
    off = {name: at(path, X, Y) - Z[row, col] for name, (path, _) in surfaces.items()}
    common = np.all([np.isfinite(values) for values in off.values()], axis=0)
    found = {}
    for name, (_, seconds) in surfaces.items():
        known = off[name][np.isfinite(off[name])]
        found[name] = {
            "known": float(np.isfinite(off[name]).mean()),
            "median_m": float(np.median(known)),
            "nmad_m": nmad(known),
            "nmad_where_all_m": nmad(off[name][common]),
            "within_2_m": float((np.abs(known - np.median(known)) < 2).mean()),
            "cpu_s": seconds,
        }
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cars", action="store_true", help="also the satellite images, beside CARS")
    parser.add_argument("--json", type=Path)
    words = parser.parse_args()
    found = {"motorcycle": motorcycle()}
    if words.cars:
        found["triplet"] = triplet()
    for scene, rows in found.items():
        print(scene)
        for name, figures in rows.items():
            print(f"  {name:48}", "  ".join(f"{key} {value:.3f}" for key, value in figures.items()))
    if words.json:
        words.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
