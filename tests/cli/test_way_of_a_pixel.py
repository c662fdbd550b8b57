"""The way of a pixel from the command to the kernel: short, and down all the way (`docs/explanation/one-idea.md`)."""

from __future__ import annotations

import re
import threading
import traceback
from pathlib import Path
from typing import Any

import pytest
from tools.command import OPTIONS, Here
from tools.small_block import Block

from photoplan.engine import execute, executors

#: Frames of the package from the command to the kernel, both counted.
MOST = 11
#: Each layer may call those below it.
LAYERS = ["cli", "products", "engine", "kernels"]
PAGE = Path(__file__).parents[2] / "docs/explanation/one-idea.md"


def frames() -> list[tuple[str, str]]:
    """Module and function of each frame of the package that is running, the outermost first."""
    found = []
    for frame in traceback.extract_stack():
        _, inside, path = frame.filename.replace("\\", "/").partition("/src/photoplan/")
        if inside:
            found.append((path.removesuffix(".py"), frame.name))
    return found


@pytest.mark.parametrize("workers", [1, 2])
def test_eleven_frames_and_never_up(
    photoplan: Here, pristine: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int
) -> None:
    ways: list[list[tuple[str, str]]] = []
    handed: list[list[tuple[str, str]]] = []
    rectify, pool = execute.rectify_tile, executors.ThreadPoolExecutor.submit

    def looked(*arguments: Any, **more: Any) -> Any:
        ways.append(frames())
        return rectify(*arguments, **more)

    def submitted(self: Any, *arguments: Any) -> Any:
        # The pool of assembling is another one.
        if threading.current_thread() is threading.main_thread() and len(arguments) == 2:
            handed.append(frames())
        return pool(self, *arguments)

    monkeypatch.setattr(execute, "rectify_tile", looked)
    monkeypatch.setattr(executors.ThreadPoolExecutor, "submit", submitted)
    words = ["ortho", pristine.project, *OPTIONS, "--images", "one", "--output", tmp_path, "--workers", workers]
    assert photoplan(*words).code == 0
    way = handed[0] + ways[0]
    way = [*way[[name for _, name in way].index("command") :], ("kernels/rectify", "rectify_tile")]
    assert len(way) <= MOST, way
    layers = [LAYERS.index(path.split("/")[0]) for path, _ in way]
    assert layers == sorted(layers), way
    if workers == 1:
        drawn = re.findall(r"^ *\d+ +([\w/]+)\.py +([\w.]+)", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
        assert [(path, name.split(".")[-1]) for path, name in drawn] == way
