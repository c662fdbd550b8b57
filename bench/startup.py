"""What `photoplan ortho` takes before and after its pixels: a product of one tile of the included block.

    python bench/startup.py

Prints processor seconds (user + system), the least of some runs: imports alone, a product, and its quick look. Start-up
is what the first product of a process costs more than the second: imports and loading of compiled kernels, and the
start of Python. As for a user, no process compiles all modules anew: PYTHONDONTWRITEBYTECODE is not handed on.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from importlib.resources import as_file, files
from pathlib import Path

RUNS = 7

IMPORTS = (
    "import os; from photoplan.cli import main; main.start(); import photoplan.products.orthophoto.make; os._exit(0)"
)
TWICE = """
import sys, time
from photoplan.cli import main
main.start()
times = [0.0]
for _ in range(2):
    main.run(sys.argv[1:])
    times.append(time.process_time())
print(2 * times[1] - times[2])
"""


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def start_up(*words: object) -> float:
    """What the first of two equal commands in a process costs more than the second, seconds."""
    call = [sys.executable, "-c", TWICE, *map(str, words)]
    runs = [subprocess.run(call, check=True, capture_output=True, text=True, env=environment()) for _ in range(RUNS)]
    return min(float(run.stdout.split()[-1]) for run in runs)


def cpu_of(*words: object) -> float:
    """Least processor time of a few runs of Python, seconds."""
    taken = []
    for _ in range(RUNS):
        before = os.times()
        subprocess.run([sys.executable, *map(str, words)], check=True, capture_output=True, env=environment())
        after = os.times()
        taken.append(after.children_user + after.children_system - before.children_user - before.children_system)
    return min(taken)


def cold(folder: Path, command: str, *words: object) -> str:
    """Seconds and kernels of `photoplan warmup COMMAND` with an empty cache, then seconds of the command."""
    cache = {**environment(), "NUMBA_CACHE_DIR": str(folder / f"cold-{command}")}
    said = []
    for call in (["warmup", command, "--json", "-q"], [command, *words, "--overwrite", "-q"]):
        before, began = os.times(), time.perf_counter()
        line = [sys.executable, "-m", "photoplan", *map(str, call)]
        done = subprocess.run(line, check=True, capture_output=True, text=True, env=cache)
        after, clock = os.times(), time.perf_counter() - began
        cpu = after.children_user + after.children_system - before.children_user - before.children_system
        kernels = f", {json.loads(done.stdout)['kernels']} kernels" if call[0] == "warmup" else ""
        said.append(f"{call[0]} {cpu:.1f} CPU s, {clock:.1f} s by the clock{kernels}")
    return "; then ".join(said)


def main() -> None:
    """All rows."""
    with as_file(files("photoplan") / "demo_block") as block, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = ["-m", "photoplan.cli.main"]
        inputs = ["--images", block / "images" / "*.jpg", "--camera", block / "int.yaml", "--orientation"]
        inputs += [block / "ext.csv", "--terrain", block / "dsm.tif", "--height-system", "same"]
        words = [sys.executable, *command, "init", folder, *inputs]
        subprocess.run([str(word) for word in words], check=True, capture_output=True)
        first = sorted((block / "images").glob("*.jpg"))[0].stem
        ortho = [*command, "ortho", folder / "project.toml", "--images", f"{first}*", "--resolution", 2, "--workers", 1]
        ortho += ["--overwrite", "-q"]
        cpu_of(*ortho)
        rows = {
            "import numba": cpu_of("-c", "import numba"),
            "imports of photoplan ortho": cpu_of("-c", IMPORTS),
            "photoplan ortho, one tile": cpu_of(*ortho),
            "without its quick look": cpu_of(*ortho, "--no-quicklook"),
            "start-up of photoplan ortho": start_up(*ortho[2:]),
        }
        project = [folder / "project.toml", "--images", "DJI_001*", "--resolution", 0.1]
        for command_ in ("ortho", "mosaic"):
            print(f"empty cache: {cold(folder, command_, *project)}")
    for what, seconds in rows.items():
        print(f"{what:<28} {seconds:6.2f} CPU s")


if __name__ == "__main__":
    main()
