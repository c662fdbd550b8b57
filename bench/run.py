"""The same orthophoto by photoplan, orthority and gdalwarp: CPU seconds, wall seconds, peak memory, agreement.

    python bench/run.py [--quick] [--large] [--repeat N] [--json FILE]

One real aerial frame, enlarged 6 and 12 times; cubic, three bands, uncompressed, no overviews, one thread where the
program lets itself be told. Whole processes are measured, from start to end. Runs of the programs alternate, medians
are compared. Whatever is missing (a program, the data) is named and its rows are left out. A satellite image
(satellite.py), a strip of a line camera (strips.py), terrain models from measured points (terrain.py), orientation
(orientation.py), the rate of filters (filter.py), mosaics (mosaics.py; otb.py beside OTB) and views (views.py) follow.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import rasterio
from agreement import compare
from filter import report_filter
from mosaics import report_mosaics
from oblique import report_oblique
from orientation import report_orientation
from otb import report_otb
from owners import report_owners
from planning import report_planning
from prepare import DATA, LARGE, SMALL, WORK, Source, prepare
from programs import Bounds, Missing, Program, gdalwarp, orthority, photoplan
from satellite import report_satellite
from strips import report_strips
from terrain import report_terrain
from views import report_views

HERE = Path(__file__).resolve().parent
MIB = 2**20

#: Least ratio of CPU seconds, theirs / ours, by program and factor of enlargement; what is not here is shown only.
TARGETS = {("orthority", 6): 1.5, ("orthority", 12): 4.0, ("gdalwarp exact", 6): 8.0, ("gdalwarp exact", 12): 8.0}
#: Most peak memory of ours, MiB.
MEMORY_TARGET = 400


@dataclass(frozen=True)
class Entry:
    """A program and how often it runs at a size."""

    program: Program
    runs: int


class Failed(Exception):
    """A program that ended with an error."""


def measure(program: Program, source: Source, bounds: Bounds | None) -> dict:
    """One run into an empty folder; see measure.py for the figures."""
    folder = folder_of(program, source)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    command = [sys.executable, HERE / "measure.py", *program.command(source, folder, bounds)]
    cost = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    if cost["code"] != 0 or not program.product(folder).exists():
        raise Failed(f"{program.name} ended with code {cost['code']}: {cost['stderr'].strip()}")
    del cost["stderr"], cost["code"]
    return cost


def folder_of(program: Program, source: Source) -> Path:
    return source.folder / "products" / program.name.replace(" ", "_")


def available(makers: list[Callable[[], Program]]) -> Iterator[Program]:
    for make in makers:
        try:
            yield make()
        except Missing as reason:
            print(f"left out: {reason}")


def compare_at(source: Source, entries: list[Entry]) -> dict:
    """All runs at one size, alternating, and the products' agreement with ours."""
    prepare(source)
    programs = [entry.program for entry in entries]
    first, others = programs[0], programs[1:]
    # The first run of ours after a change compiles its kernels; it is shown and not counted.
    compiling = measure(first, source, None)
    bounds = None
    if others and others[0].name.startswith("orthority"):
        # It cannot be told the edges of its product, so the others take its edges over.
        measure(others[0], source, None)
        bounds = edges(others[0], source)
    bounds = bounds or edges(first, source)
    costs: dict[str, list[dict]] = {program.name: [] for program in programs}
    for turn in range(max(entry.runs for entry in entries)):
        for entry in entries:
            if turn < entry.runs:
                print(f"  {entry.program.name} …", file=sys.stderr)
                costs[entry.program.name].append(measure(entry.program, source, bounds))
    with rasterio.open(first.product(folder_of(first, source))) as data:
        size = data.width, data.height, data.count
    agreement = {
        other.name: asdict(compare(first.product(folder_of(first, source)), other.product(folder_of(other, source))))
        for other in others
    }
    return {
        "factor": source.factor,
        "resolution": source.resolution,
        "size": size,
        "rpc_residual_px": float(source.rpc_residual.read_text()),
        "first_run": compiling,
        "runs": costs,
        "agreement": agreement,
    }


def edges(program: Program, source: Source) -> Bounds:
    with rasterio.open(program.product(folder_of(program, source))) as data:
        return tuple(data.bounds)


def median(costs: list[dict], key: str) -> float:
    return statistics.median(cost[key] for cost in costs)


def verdict(reached: bool) -> str:
    return "reached" if reached else "NOT REACHED"


def report(result: dict) -> None:
    """The rows of one size."""
    width, height, bands = result["size"]
    print(f"\n{width} × {height} × {bands} at {result['resolution']:g} m ({width * height / 1e6:.0f} Mpx)")
    print(f"  camera as RPC: off by at most {result['rpc_residual_px']:.6f} px of the source")
    print(f"  {'':24}{'runs':>5}{'CPU s':>9}{'wall s':>9}{'peak MiB':>10}{'CPU / ours':>12}")
    ours = median(next(iter(result["runs"].values())), "cpu")
    for name, costs in result["runs"].items():
        cpu, wall, memory = (median(costs, key) for key in ("cpu", "wall", "memory"))
        print(f"  {name:24}{len(costs):5}{cpu:9.2f}{wall:9.2f}{memory / MIB:10.0f}{cpu / ours:12.2f}", end="")
        target = TARGETS.get((name, result["factor"]))
        print(f"   to reach {target:g}: {verdict(cpu / ours >= target)}" if target else "")
    most = max(cost["memory"] for cost in next(iter(result["runs"].values()))) / MIB
    print(f"  peak memory of ours {most:.0f} MiB; to reach ≤ {MEMORY_TARGET}: {verdict(most <= MEMORY_TARGET)}")
    first = result["first_run"]
    print(f"  first run of ours, compiling what has changed: {first['cpu']:.1f} CPU s, {first['wall']:.1f} s")
    for name, a in result["agreement"].items():
        print(
            f"  ours against {name}: offset {a['dx']:+.3f} {a['dy']:+.3f} px ({a['patches']} patches), "
            f"{a['within']:.1%} of the values within 2 grey levels, median {a['median']:g}, "
            f"{a['common']:.2%} of the pixels in both"
        )


def report_kernel_rates() -> dict | None:
    """Rates of the tile kernel alone, where its measurement is there."""
    try:
        from kernel_rate import kernel_rates  # noqa: PLC0415
    except ImportError as error:
        print(f"left out: rates of the kernel alone ({error})")
        return None
    print("\nTile kernel alone (geometry, relief and cubic), one core, Mpx/s; to reach with uint8 x 3: ratio 0.8")
    print(f"  {'':22}{'photoplan':>10}{'cv2.remap':>12}{'ratio':>8}{'packing':>10}")
    rates = kernel_rates()
    for name, row in rates.items():
        cells = [row.get(key) for key in ("ours", "cv2_remap", "ratio", "pack")]
        print(f"  {name:22}" + "".join(f"{'' if c is None else c:>{w}}" for c, w in zip(cells, (10, 12, 8, 10))))
    return rates


def machine() -> str:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    return f"{os.cpu_count()} cores, {model}; load {os.getloadavg()[0]:.1f}; Python {platform.python_version()}"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the smaller sizes only (27 Mpx, 100 000 points)")
    parser.add_argument(
        "--large", action="store_true", help="also a terrain of ten million points (a quarter of an hour)"
    )
    parser.add_argument("--repeat", type=int, default=3, metavar="N", help="runs of each program [3]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    return parser.parse_args()


def main() -> int:
    options = arguments()
    warnings.filterwarnings("ignore", category=rasterio.errors.NotGeoreferencedWarning)
    print(machine())
    results: dict = {"machine": machine(), "kernel": report_kernel_rates(), "sizes": []}
    if not DATA.is_dir():
        print("left out: the comparison of programs (the folder `shared` with test data is not beside the checkout)")
    else:
        WORK.mkdir(exist_ok=True)
        makers = [photoplan, lambda: orthority("cubic"), lambda: orthority("bilinear")]
        makers += [lambda: gdalwarp(0.125), lambda: gdalwarp(0)]
        n = options.repeat
        for source in (SMALL,) if options.quick else (SMALL, LARGE):
            # gdalwarp takes minutes at the larger size, and its ratio is that of the smaller: once.
            few = n if source is SMALL else 1
            entries = [Entry(p, few if p.name.startswith("gdalwarp") else n) for p in available(makers)]
            results["sizes"].append(compare_at(source, entries))
            report(results["sizes"][-1])
    WORK.mkdir(exist_ok=True)
    results["satellite"] = report_satellite(1 if options.quick else options.repeat)
    results["strips"] = report_strips(options.quick)
    results["owners"] = report_owners()
    results["oblique"] = report_oblique(options.repeat)
    results["filter"] = report_filter(options.quick)
    results["terrain"] = report_terrain(options.quick, options.large)
    results["orientation"] = report_orientation(options.quick)
    results["planning"] = report_planning(options.quick)
    results["mosaics"] = report_mosaics(options.quick)
    results["otb"] = report_otb(options.quick)
    results["views"] = report_views(options.quick, options.repeat)
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
