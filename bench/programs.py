"""The programs that are compared, each as one command that makes the same orthophoto."""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from prepare import FRAME, WORK, Source

ORTHORITY = WORK / "orthority-venv"
Bounds = tuple[float, float, float, float]

_TILED = ["-co", "TILED=YES", "-co", "BLOCKXSIZE=512", "-co", "BLOCKYSIZE=512"]


class Missing(Exception):
    """A program that is not there, and why."""


@dataclass(frozen=True)
class Program:
    """A program, and how it is called: cubic, three bands, uncompressed, no overviews, one thread."""

    name: str
    command: Callable[[Source, Path, Bounds | None], list[str]]
    """Arguments for a source, an empty folder, and the product's outer edges (None: the program's own)."""
    product: Callable[[Path], Path]
    """The file that appears in the folder."""


def photoplan() -> Program:
    """This checkout's program, as installed for the Python that runs the comparison."""
    script = Path(sys.executable).with_name("photoplan")
    if not script.exists():
        raise Missing(f"photoplan: {script} is not there; pip install . first")

    def command(source: Source, folder: Path, bounds: Bounds | None) -> list[str]:
        call = [script, "ortho", source.project, "--images", FRAME, "--resolution", source.resolution]
        call += ["--kernel", "bicubic", "--compress", "none", "--no-overviews", "--no-quicklook", "--workers", 1]
        call += ["--output", folder, "--json"]
        call += ["--bounds", *bounds] if bounds else []
        return [str(part) for part in call]

    return Program("photoplan", command, lambda folder: folder / f"{FRAME}_ortho.tif")


def install_orthority() -> Path:
    """orthority's command, installed into an environment of its own when it is first needed."""
    script = ORTHORITY / "bin" / "oty"
    if not script.exists():
        print("installing orthority into an environment of its own …", file=sys.stderr)
        try:
            venv.create(ORTHORITY, with_pip=True, clear=True)
            subprocess.run([ORTHORITY / "bin" / "pip", "install", "--quiet", "orthority"], check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise Missing(f"orthority: could not be installed ({error})") from None
    return script


def orthority(terrain: str) -> Program:
    """orthority in an environment of its own.

    `terrain` is its interpolation of heights: ``cubic`` is its default, ``bilinear`` what the others do here.
    """
    script = install_orthority()

    def command(source: Source, folder: Path, bounds: Bounds | None) -> list[str]:
        call = [script, "frame", "-r", source.resolution, "-ap", "-ip", source.camera, "-ep", source.orientation]
        call += ["-d", source.terrain, "-c", source.crs, "-i", "cubic", "-di", terrain, "-nbo", "-nwm", *_TILED]
        call += ["--out-dir", folder, source.image]
        return [str(part) for part in call]

    name = "orthority" if terrain == "cubic" else f"orthority -di {terrain}"
    return Program(name, command, lambda folder: folder / f"{FRAME}_ORTHO.tif")


def gdalwarp(error_threshold: float) -> Program:
    """GDAL's warper with the camera as RPC tags; `error_threshold` in pixels, 0 = exact."""
    script = shutil.which("gdalwarp")
    if script is None:
        raise Missing("gdalwarp: not found; on Debian it is in the package gdal-bin")

    def command(source: Source, folder: Path, bounds: Bounds | None) -> list[str]:
        assert bounds is not None
        # Heights of camera and terrain are in one system, so the terrain's geoid must not be applied.
        call = [script, "-q", "-rpc", "-to", f"RPC_DEM={source.terrain}", "-to", "RPC_DEM_APPLY_VDATUM_SHIFT=NO"]
        call += ["-to", "RPC_DEMINTERPOLATION=bilinear", "-et", error_threshold, "-r", "cubic", "-dstnodata", 0]
        call += ["-t_srs", source.crs, "-te", *bounds, "-tr", source.resolution, source.resolution, *_TILED]
        call += [source.image_with_rpc, folder / "warped.tif"]
        return [str(part) for part in call]

    name = "gdalwarp exact" if error_threshold == 0 else f"gdalwarp -et {error_threshold:g}"
    return Program(name, command, lambda folder: folder / "warped.tif")
