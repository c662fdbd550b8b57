"""Orientation: bundle adjustment of a real block and of simulated ones of two sizes, fiducial marks of real scans.

    python bench/orientation.py [--quick] [--json FILE]

Whole processes are measured, reading, report and writing included.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

from prepare import CHECKOUT, WORK

HERE = Path(__file__).resolve().parent
MIB = 2**20
FOLDER = WORK / "orientation"
DATA = CHECKOUT.parent / "shared" / "data"
sys.path.insert(0, str(CHECKOUT / "tests"))

#: The real block: seconds, MiB and pixels at most.
SECONDS_TARGET, MEMORY_TARGET, SIGMA_TARGET = 60.0, 1536.0, 0.25
#: Affine residual of the marks of a scan at most, micrometres.
MARKS_TARGETS = {"act1997_run25_028_400dpi": 12.0, "act1989_run20_157_300dpi": 70.0, "act1993_run37_067_300dpi": 70.0}
#: Simulated blocks: strips, images in a strip, points in an image.
SIZES = {"small": (4, 15, 300), "large": (10, 30, 600)}

SIMULATED = """
import sys
sys.path.insert(0, sys.argv[1])
from tools.sim_block import simulate
from photoplan.orientation.bundle.adjust import adjust_block
strips, images, points = map(int, sys.argv[2:5])
block = simulate(1, strips=strips, images=images, per_image=points, gnss=0.05, gross=0.02, control=25).block
if sys.argv[5] == "adjust":
    result = adjust_block(block)
    print(len(block.observations), len(result.points), result.sigma0, result.iterations, file=sys.stderr)
else:
    print(len(block.observations), file=sys.stderr)
"""


def measure(*command: object) -> dict:
    """What a command costs; see measure.py for the figures."""
    words = [sys.executable, str(HERE / "measure.py"), *map(str, command)]
    cost = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    if cost["code"] != 0:
        raise SystemExit(f"{' '.join(map(str, command))} failed:\n{cost['stderr']}")
    return cost


def photoplan(*words: object) -> list[str]:
    return [sys.executable, "-m", "photoplan.cli.main", *map(str, words)]


def real_block() -> dict | None:
    """The UltraCam block of 805 exposures, from noisy orientations to the report."""
    data = DATA / "ign_borea"
    if not data.is_dir():
        print("ign_borea: needs the folder `shared` beside the checkout; left out")
        return None
    ign_project = importlib.import_module("tools.ign_block").ign_project
    folder = FOLDER / "ign"
    shutil.rmtree(folder, ignore_errors=True)
    project = ign_project(folder, data)
    cost = measure(*photoplan("adjust", project, "-q"))
    facts = json.loads((folder / "adjustment" / "report.json").read_text())
    (group,) = [g for g in facts["groups"] if g["name"].startswith("image points")]
    sigma = 0.25 * group["found_to_stated"]
    row = {
        "images": len(facts["images"]),
        "measurements": facts["measurements"],
        "sigma0_px": sigma,
        "wall": cost["wall"],
        "MiB": cost["memory"] / MIB,
    }
    met = row["wall"] <= SECONDS_TARGET and row["MiB"] <= MEMORY_TARGET and sigma <= SIGMA_TARGET
    print(
        f"ign_borea  {row['images']} images, {row['measurements']} measurements: sigma0 {sigma:.3f} px "
        f"(≤ {SIGMA_TARGET}), {row['wall']:.1f} s (≤ {SECONDS_TARGET:g}), {row['MiB']:.0f} MiB (≤ {MEMORY_TARGET:g})  "
        f"{'met' if met else 'MISSED'}"
    )
    return row


def simulated(quick: bool) -> list[dict]:
    """Blocks with 2 % gross errors; the cost of making them is taken off."""
    rows = []
    for name, size in SIZES.items():
        if quick and name == "large":
            continue
        command = [sys.executable, "-c", SIMULATED, CHECKOUT / "tests", *size]
        empty, cost = measure(*command, "make"), measure(*command, "adjust")
        measurements = int(cost["stderr"].split()[0])
        row = {
            "block": name,
            "images": size[0] * size[1],
            "measurements": measurements,
            "cpu": cost["cpu"] - empty["cpu"],
            "MiB": cost["memory"] / MIB,
        }
        rows.append(row)
        print(
            f"simulated  {row['images']} images, {measurements} measurements: {row['cpu']:.1f} s of processor time, "
            f"{1e6 * row['cpu'] / measurements:.0f} µs for each, {row['MiB']:.0f} MiB"
        )
    return rows


def marks() -> list[dict]:
    """Fiducial marks of whole scans, found unaided."""
    folder = DATA / "film_act_canberra"
    if not folder.is_dir():
        print("film_act_canberra: needs the folder `shared` beside the checkout; left out")
        return []
    rows = []
    camera = HERE / "wild_camera.toml"
    for name, target in MARKS_TARGETS.items():
        scan = folder / f"{name}.jpg"
        out = subprocess.run(
            photoplan("fiducials", scan, "--camera", camera, "--json", "-q"), capture_output=True, text=True
        )
        cost = measure(*photoplan("fiducials", scan, "--camera", camera, "--json", "-q"))
        (facts,) = json.loads(out.stdout)["images"]
        worst = max(math.hypot(*mark["residual_um"]) for mark in facts["marks"])
        rows.append({"scan": name, "worst_um": worst, "wall": cost["wall"], "MiB": cost["memory"] / MIB})
        print(
            f"marks      {name}: worst residual {worst:.1f} µm (≤ {target:g}), {cost['wall']:.1f} s, "
            f"{cost['memory'] / MIB:.0f} MiB  {'met' if worst <= target else 'MISSED'}"
        )
    return rows


def report_orientation(quick: bool) -> dict:
    """All rows, printed and as values."""
    print("\nOrientation")
    return {"real": real_block(), "simulated": simulated(quick), "marks": marks()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the small simulated block only")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    results = report_orientation(options.quick)
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
