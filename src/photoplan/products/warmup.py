"""Compilation of kernels: as a phase before the work of a command, and by `photoplan warmup`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.events import COMPILING, Events
from photoplan.findings import Result
from photoplan.io.files import read_toml, resolve_input
from photoplan.io.raster_info import read_info
from photoplan.kernels.precompile import PixelSignatures, compile_for
from photoplan.plain import pick
from photoplan.requests.project import WarmupRequest


@dataclass(frozen=True)
class WarmupReport(Result):
    """Kernels that were compiled for commands."""

    commands: tuple[str, ...]
    kernels: int
    """Number of kernels that were compiled; those in the cache are not counted."""
    seconds: float

    def json_fields(self) -> dict[str, Any]:
        """Return the commands, the number of kernels and the seconds they took."""
        return pick(self, "commands", "kernels", "seconds")

    def summary(self) -> Sequence[str]:
        """Return one line."""
        if not self.kernels:
            return ["all kernels are compiled already"]
        return [f"{self.kernels} kernel{'s' * (self.kernels > 1)} compiled in {self.seconds:.1f} s"]


def warm_up(request: WarmupRequest, commands: Sequence[str], events: Events) -> WarmupReport:
    """Compile the kernels of commands, by their names in the list of kernels."""
    began = time.perf_counter()
    pixels = [PixelSignatures(dtype, request.bands, request.kernel) for dtype in request.dtypes]
    count = _compile(commands, pixels, events, request.workers)
    return WarmupReport(tuple(commands), count, time.perf_counter() - began)


def compile_before(command: str, request: Any, events: Events) -> None:
    """Compile what a command needs before its work; what fails here is compiled when it is first called."""
    if getattr(request, "dry_run", False) or getattr(request, "plan_file", None) is not None:
        return
    with suppress(Exception):
        pixels = PixelSignatures(kernel=getattr(request, "kernel", None) or PixelSignatures().kernel)
        project = getattr(request, "project", None)
        _compile([command], [_of_images(Path(project), pixels) if project is not None else pixels], events)


def _compile(
    commands: Sequence[str], pixels: Sequence[PixelSignatures], events: Events, processes: int | None = None
) -> int:
    return compile_for(
        commands, pixels, lambda count: events.begin(COMPILING, count, "kernels"), lambda: events.done(), processes
    )


def _of_images(project: Path, pixels: PixelSignatures) -> PixelSignatures:
    """Return the kind of pixels of a project's first image.

    Raises
    ------
    Exception
        The project, or the image, cannot be read; the command itself says so.
    """
    table = read_toml(project)[0]
    info = read_info(resolve_input(project.resolve().parent, table["images"][0]["file"]))
    stated = table.get("ortho", {}).get("kernel", pixels.kernel)
    return PixelSignatures(str(info.dtype), info.bands, stated if pixels == PixelSignatures() else pixels.kernel)
