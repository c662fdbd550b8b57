"""What a command loads before its work: each module here costs every start some hundredths of a second or more."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.resources import as_file, files
from pathlib import Path

from photoplan.cli.main import run
from photoplan.kernels.numba_internals import USABLE

#: Not needed for an orthophoto over a raster of heights.
HEAVY = [
    "scipy.linalg",
    "scipy.sparse",
    "scipy.ndimage",
    "pandas",
    "matplotlib",
    "xarray",
    "cv2",
    "rich",
    "distributed",
]
HEAVY += ["shapely", "pyogrio", "psutil", "tomlkit", "dask", "laspy"]
SCRIPT = """
import os, sys
os._exit = sys.exit
from photoplan.cli import main
sys.argv[0] = "photoplan"
try:
    main.main()
finally:
    print(*sys.modules)
    print(os.environ["OPENBLAS_NUM_THREADS"])
"""


def test_an_orthophoto_loads_nothing_that_it_does_not_need(tmp_path: Path) -> None:
    with as_file(files("photoplan") / "demo_block") as block:
        image = sorted((block / "images").glob("*.jpg"))[0]
        words = ["init", tmp_path, "--images", image, "--camera", block / "int.yaml"]
        words += ["--orientation", block / "ext.csv", "--terrain", block / "dsm.tif", "--height-system", "same"]
        assert run([str(word) for word in words]) == 0
        first = image.stem
        words = ["ortho", tmp_path / "project.toml", "--images", f"{first}*", "--resolution", 2, "--overwrite"]
        environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
        for _ in range(2):
            talk = subprocess.run(
                [sys.executable, "-c", SCRIPT, *map(str, words), "--no-quicklook", "-q"],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
            ).stdout
            product, modules, threads = talk.splitlines()
            assert Path(product).name == f"{first}_ortho.tif"
            assert threads == "1"
            heavy = [name for name in HEAVY if USABLE or not name.startswith("scipy")]  # else numba loads it
            found = [name for name in heavy if name in modules.split()]
            if not found:
                break  # the first of the two may compile, and load what that needs
    assert found == []
