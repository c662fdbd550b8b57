"""Kernels are compiled once, not in every process."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from numba import njit
from numba.core.errors import TypingError
from tools.small_block import write_block

from photoplan.errors import PhotoplanWarning
from photoplan.events import COMPILATIONS
from photoplan.kernels import jit, numba_internals
from photoplan.kernels.jit import COMPILED
from photoplan.kernels.rectify import is_compiled

SCRIPT = """
import numpy as np
from photoplan.kernels.resample import gather_runs
from photoplan.kernels.positions import find_taps
from photoplan.kernels.rectify import is_compiled, rectify_tile
before = is_compiled("int16", 3, "bilinear")
corners = np.array([[[u, v, 1.0] for h in (0, 1) for v in (-.5, 3.5) for u in (-.5, 3.5)]])
anchors = (np.array([[0, 0, 4, 4]], np.int32), np.array([0, 1], np.int32), np.array([[0.0, 1.0]]), corners,
           np.zeros(5), np.empty((0, 0, 2), np.float32))
arrays = np.ones((3, 4, 4), np.int16), np.empty((3, 4, 4), np.int16), np.empty((4, 4), bool)
rectify_tile(anchors, np.zeros((4, 4), np.float32), arrays[0], None, None, "bilinear", arrays[1], arrays[2])
assert (arrays[1] == 1).all()
compiled = [sum(kernel.stats.cache_misses.values()) for kernel in (gather_runs, find_taps)]
print(before, is_compiled("int16", 3, "bilinear"), *compiled)
"""


@pytest.mark.slow
@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_second_process_loads_what_the_first_compiled(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    talk = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    ]
    assert talk[0].split() == ["False", "True", "1", "1"]
    # What lies on the disk is asked of numba's inside; where that is not leaned on, the answer is no.
    assert talk[1].split() == [str(numba_internals.USABLE), "True", "0", "0"]


def _compiled(path: Path):
    """Functions of a file that numba compiles."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.FunctionDef) and {"kernel", "inner", "maker"} & {
            ast.unparse(d) for d in node.decorator_list
        }:
            yield node


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_no_kernel_assigns_an_array_to_a_slice_or_takes_differences():
    """Either makes numba compile messages about shapes, text and all: 3 s for each kernel, of every new user."""
    seen = 0
    for path in sorted(Path(jit.__file__).parent.glob("*.py")):
        for function in _compiled(path):
            seen += 1
            for node in ast.walk(function):
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
                    sliced = any(isinstance(each, ast.Slice) for each in ast.walk(node.targets[0].slice))
                    names = {each.id for each in ast.walk(node.value) if isinstance(each, ast.Name)} - {"np"}
                    assert not (sliced and names), f"{path.name}: {function.name}: {ast.unparse(node)}"
                taken = isinstance(node, ast.Attribute) and node.attr == "diff"
                assert not taken, f"{path.name}: {function.name}: np.diff"
    assert seen > 150


def test_only_kernels_whose_sources_have_changed_are_compiled_again(tmp_path):
    """Those of a file, of files that it imports, and of files that these import; no others."""
    sources = {
        "a": "\nfrom photoplan.kernels.b import x\n",
        "b": "\nfrom photoplan.kernels import c\n",
        "c": "",
        "d": "",
    }

    def stamps():
        for function in (numba_internals.stamp, numba_internals.source):
            function.cache_clear()
        return {name: numba_internals.stamp(str(tmp_path / f"{name}.py"), str(tmp_path)) for name in sources}

    for name, text in sources.items():
        (tmp_path / f"{name}.py").write_text(text)
    before = stamps()
    assert before["a"] != before["b"] != before["d"]
    (tmp_path / "c.py").write_text("other = 1\n")
    assert [name for name, each in stamps().items() if each != before[name]] == ["a", "b", "c"]


def test_all_that_kernels_import_from_each_other_is_found():
    folder = Path(jit.__file__).parent
    for path in folder.glob("*.py"):
        wanted = set()
        for node in ast.walk(ast.parse(path.read_bytes())):
            assert not (isinstance(node, ast.Import) and any("photoplan" in name.name for name in node.names)), (
                path.name
            )
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("photoplan.kernels"):
                named = node.module.removeprefix("photoplan.kernels").strip(".")
                wanted |= {named} if named else {name.name for name in node.names}
        assert {Path(each).stem for each in numba_internals.source(str(path), str(folder))[1]} == wanted, path.name


LOADED = """
import sys
import numpy as np
from photoplan.kernels.terrain import height_ranges
ranges = height_ranges(np.ones((2, 3), np.float32), np.array([[0, 0, 3, 2]], np.int32))
print(ranges[0], "numba.np.linalg" in sys.modules)
"""


@pytest.mark.skipif(not numba_internals.USABLE, reason="nothing is compiled, or by numba's documented ways")
def test_what_is_compiled_is_loaded_without_the_compiler_s_libraries(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    for compiles in (True, False):
        talk = subprocess.run(
            [sys.executable, "-c", LOADED], env=environment, check=True, capture_output=True, text=True
        )
        assert talk.stdout.split() == ["[1.", "1.]", str(compiles)]


class Old:
    """A class of types of a kernel, which another version of the package does not have."""


@pytest.mark.skipif(not numba_internals.USABLE, reason="nothing is compiled, or by numba's documented ways")
def test_what_was_kept_by_another_version_or_is_damaged_is_compiled_again(tmp_path, monkeypatch):
    kept = numba_internals._CacheIndex(str(tmp_path), "kernel", ("sources", 0))
    kept.save(Old, "code")
    assert kept.load(Old) == "code"
    with monkeypatch.context() as without:
        without.delattr(sys.modules[__name__], "Old")
        assert kept.load(int) is None
        kept.save(int, "new")
    assert kept.load(int) == "new" and kept.load(Old) is None
    for path in tmp_path.glob("kernel*"):
        path.write_bytes(path.read_bytes()[:-3])
        assert kept.load(int) is None
        kept.save(int, "new")
        assert kept.load(int) == "new"


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_compilations_are_counted_as_they_happen():
    """A kernel counts once for each set of types, with the functions that it calls; a later call counts nothing."""

    @jit.inner
    def part(x):
        return 2 * x

    @njit
    def whole(x):
        return part(x) + 1

    seen = []

    def watch():
        seen.append((COMPILATIONS.running, COMPILATIONS.kernels - before))

    before, seconds = COMPILATIONS.kernels, COMPILATIONS.seconds
    COMPILATIONS.watchers.append(watch)
    try:
        assert whole(1) == whole(2) - 2 == 3
        assert seen == [(True, 1), (True, 1), (True, 1), (False, 1)]
        assert whole(1.0) == 3
        assert seen[-1] == (False, 2) and COMPILATIONS.seconds > seconds
        after = COMPILATIONS.seconds
        with pytest.raises(TypingError):
            whole("text")
        assert not COMPILATIONS.running and COMPILATIONS.seconds >= after
    finally:
        COMPILATIONS.watchers.remove(watch)


@pytest.mark.slow
@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_a_cold_command_reports_its_compilation(tmp_path):
    """Whoever makes orthophotos first reads how many kernels are compiled; the rate is that of the tiles."""
    write_block(tmp_path / "block")
    words = ["ortho", tmp_path / "block" / "project.toml", "--images", "one", "--resolution", "2", "--workers", "2"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    said = [
        subprocess.run(
            [sys.executable, "-m", "photoplan", *map(str, words), "-o", str(tmp_path / out)],
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        ).stderr
        for out in ("cold", "warm")
    ]
    assert re.search(r"^compiling: \d+/\d\d kernels for 0:0\d:\d\d$", said[0], re.MULTILINE)
    # That is a phase before the tiles: none of their seconds are to compile, in either run.
    assert "to compile" not in said[0] + said[1] and "compiling" not in said[1]


def test_is_compiled_knows_all_kinds():
    for dtype in ("uint8", "float32"):
        for bands in (1, 3):
            assert is_compiled(dtype, bands, "lanczos3") in ((True, False) if COMPILED else (True,))


TINY = """
import os, sys, tempfile, warnings

def refuse(folder, make):
    if not str(folder).startswith(os.environ["TMPDIR"]):
        raise PermissionError(13, "Read-only file system", str(folder))
    return make()

plain = tempfile.TemporaryFile
tempfile.TemporaryFile = lambda *args, dir=None, **more: refuse(dir, lambda: plain(*args, dir=dir, **more))
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    from photoplan.kernels.jit import kernel
    import tiny
print(tiny.once(2.0) + tiny.twice(2.0), sum(tiny.twice.stats.cache_misses.values()), len(said))
print(*(each.message for each in said), os.environ.get("NUMBA_CACHE_DIR"))
"""
TINY_KERNELS = """
from photoplan.kernels.jit import kernel

@kernel
def once(x):
    return x

@kernel
def twice(x):
    return 2 * x
"""


@pytest.fixture
def nowhere(tmp_path):
    """Runs `TINY` where numba finds no folder of its own that it may write."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "tiny.py").write_text(TINY_KERNELS)
    (tmp_path / "temporary").mkdir()
    path = os.pathsep.join(filter(None, [str(tmp_path / "code"), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": path, "TMPDIR": str(tmp_path / "temporary")}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run(**more):
        done = subprocess.run(
            [sys.executable, "-c", TINY], env=environment | more, check=True, capture_output=True, text=True
        )
        return done.stdout.split("\n", 1)

    return run


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_where_nothing_can_be_written_a_temporary_folder_is_used_and_named_once(nowhere, tmp_path):
    for misses in (1, 0):
        figures, talk = nowhere()
        assert figures.split() == ["6.0", str(misses), "1"]
        assert talk.count(str(tmp_path / "temporary" / "photoplan-kernels-")) == 2  # it is told, and inherited
        assert "Set NUMBA_CACHE_DIR" in talk


@pytest.mark.skipif(not COMPILED or os.name != "posix", reason="nothing is compiled, or folders have no owners")
def test_a_temporary_folder_that_others_can_write_is_not_trusted(nowhere, tmp_path):
    open_to_all = tmp_path / "temporary" / f"photoplan-kernels-{os.getuid()}"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    assert nowhere()[0].split() == ["6.0", "1", "1"]
    assert not list(open_to_all.iterdir())
    assert len(list((tmp_path / "temporary").iterdir())) == 2


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_without_any_folder_kernels_work_and_it_is_said(monkeypatch):
    def refuse(dispatcher):
        raise RuntimeError("cannot cache function")

    def no_folder():
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(jit, "enable_cache", refuse)
    monkeypatch.setattr(jit.tempfile, "gettempdir", no_folder)
    with pytest.warns(PhotoplanWarning, match="NUMBA_CACHE_DIR"):
        twice = jit.kernel(lambda x: 2 * x)
    assert twice(2.0) == 4.0
