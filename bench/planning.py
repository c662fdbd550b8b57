"""Planning: `photoplan check` and the plan of orthophotos of a large block over a large terrain raster.

    python bench/planning.py [--quick] [--json FILE]

Whole processes are measured. The terrain, 20,000 × 20,000 posts (0.8 GB), is made once; the images are sparse files.
"""

from __future__ import annotations

import argparse
import importlib
import json
import shutil
import sys
from pathlib import Path

from orientation import measure, photoplan
from prepare import CHECKOUT, WORK

MIB = 2**20
sys.path.insert(0, str(CHECKOUT / "tests"))

#: Wall seconds on two cores, and MiB, at most.
SECONDS_TARGET, MEMORY_TARGET = 20.0, 500.0
PLAN = """
import sys
import photoplan
plan = photoplan.plan_orthophotos(photoplan.load_project(sys.argv[1]))
print(len(plan.products), file=sys.stderr)
"""


MOSAIC = PLAN.replace("plan_orthophotos", "plan_mosaic")


def report_planning(quick: bool) -> list[dict]:
    """All rows, printed and as values."""
    write_block = importlib.import_module("tools.large_block").write_block
    side = 5_000 if quick else 20_000
    folder = WORK / f"planning-{side}"
    folder.mkdir(parents=True, exist_ok=True)
    print(f"\nPlanning over {side:,} × {side:,} posts (asked: {SECONDS_TARGET:g} s, {MEMORY_TARGET:g} MiB)")
    rows = []
    many = 30 if quick else 500
    for name, images in (("check", 25 if quick else 400), ("plan", many), ("mosaic", many)):
        project = write_block(folder, images, side)
        script = MOSAIC if name == "mosaic" else PLAN
        command = photoplan("check", project) if name == "check" else [sys.executable, "-c", script, str(project)]
        rows.append({"what": name, "images": images, **measure(*command)})
        cost = rows[-1]
        print(
            f"  {name:<6} {images:4d} images: {cost['wall']:6.1f} s, {cost['cpu']:6.1f} CPU s, "
            f"{cost['memory'] / MIB:5.0f} MiB"
        )
    for file in folder.glob("[0-9]*.tif"):
        file.unlink()
    if quick:
        shutil.rmtree(folder)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a sixteenth of the terrain and of the images")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args()
    rows = report_planning(options.quick)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
