"""Bounds and other options of several numbers: how they are written, in which order, in which CRS."""

from __future__ import annotations

import re
from pathlib import Path

import click
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from tools.command import inside, verbs
from tools.small_block import CRS, Block

import photoplan as pp
from photoplan.cli.lazy import apart
from photoplan.errors import InputError, UsageError
from photoplan.geometry.bounds import bounds_fault

B = (500_400, 5_300_180, 500_460, 5_300_240)
NUMBERS = [
    (verb, option)
    for verb, command in verbs().items()
    for option in command.params
    if isinstance(option, click.Option)
    and option.nargs > 1
    and not isinstance(option.type, click.types.StringParamType)
]


@pytest.mark.parametrize(
    "words",
    [
        ("--bounds", "500400,5300180,500460,5300240"),
        ("--bounds", "500400,", "5300180,", "500460,", "5300240"),
        ("--bounds=500400 5300180 500460 5300240",),
        ("--bounds", "500400", "5300180", "500460", "5300240"),
        ("--bounds", "500400;5300180", "500460;5.30024e6"),
    ],
)
def test_commas_and_blanks(small: Block, tmp_path: Path, words: tuple[str, ...]) -> None:
    """Asked of every way in which people write bounds; the options around them stay what they are."""
    said = inside("ortho", *words, small.project, "--images", "three", "--resolution", 2, "-o", tmp_path)
    assert said.code == 0, said.err
    with rasterio.open(said.out.strip()) as file:
        assert tuple(file.bounds) == B


@pytest.mark.parametrize(("verb", "option"), NUMBERS, ids=lambda v: v if isinstance(v, str) else v.opts[0])
def test_every_option_of_several_numbers_is_written_alike(verb: str, option: click.Option) -> None:
    command, word = verbs()[verb], option.opts[-1]
    numbers = [str(k + 1) for k in range(option.nargs)]
    wanted = ["a", word, *numbers, "b"]
    for given in ([",".join(numbers)], [f"{n}," for n in numbers[:-1]] + numbers[-1:], [" ".join(numbers)], numbers):
        assert apart(command, ["a", word, *given, "b"]) == wanted
    assert apart(command, ["a", f"{word}={','.join(numbers)}", "b"]) == wanted
    assert apart(command, ["--", word, "1,2,3,4"]) == ["--", word, "1,2,3,4"]
    for wrong in (numbers[:-1], [",".join([*numbers, "9"])]):
        with pytest.raises(click.UsageError, match=rf"{word} takes {option.nargs} numbers"):
            apart(command, [word, *wrong, "b"])


def in_crs(crs: str, b: tuple[float, ...] = B) -> tuple[float, ...]:
    return Transformer.from_crs(CRS, crs, always_xy=True).transform_bounds(*b)


W, S, E, N = in_crs("EPSG:4326")


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ((B[0], B[2], B[1], B[3]), "xmin xmax ymin ymax, so 500400 5300180 500460 5300240 is meant"),
        ((B[0], B[3], B[2], B[1]), "xmin ymax xmax ymin, so 500400 5300180 500460 5300240 is meant"),
        ((B[1], B[0], B[3], B[2]), "ymin xmin ymax xmax, so 500400 5300180 500460 5300240 is meant"),
        ((B[2], B[3], B[0], B[1]), "xmax ymax xmin ymin, so 500400 5300180 500460 5300240 is meant"),
        ((W, S, E, N), r"longitudes and latitudes \(EPSG:4326\); needed is EPSG:32633: 500[34]\d\d"),
        ((S, W, N, E), r"latitudes and longitudes \(EPSG:4326\); needed is EPSG:32633: 500[34]\d\d"),
        (in_crs("EPSG:3857"), "are in EPSG:3857; needed is EPSG:32633"),
        (in_crs("EPSG:32632"), "are in EPSG:32632; needed is EPSG:32633"),
    ],
)
@pytest.mark.parametrize("verb", ["ortho", "mosaic", "surface"])
def test_another_order_or_crs_is_recognised(small: Block, verb: str, given: tuple[float, ...], says: str) -> None:
    said = inside(verb, small.project, "--resolution", 2, "--dry-run", "--bounds", ",".join(f"{v:.10g}" for v in given))
    assert said.code == 2 and re.search(says, said.err), said.err


def test_terrain_and_python_ask_the_same(tmp_path: Path) -> None:
    path = tmp_path / "t.tif"
    with rasterio.open(path, "w", driver="GTiff", width=60, height=60, count=1, dtype="float32", crs=CRS,
                       transform=rasterio.Affine(1, 0, B[0], 0, -1, B[3])) as file:  # fmt: skip
        file.write(np.zeros((60, 60), np.float32), 1)
    for verb, out in (("export", "e.tif"), ("shade", "s.tif"), ("contours", "c.gpkg")):
        words = ("dtm", verb, path, "-o", tmp_path / out, *(("--interval", 1) if verb == "contours" else ()))
        for given in (f"{B[1]},{B[0]},{B[3]},{B[2]}", f"{B[0]},{B[2]},{B[1]},{B[3]}", f"{W},{S},{E},{N}"):
            said = inside(*words, "--bounds", given)
            assert said.code == 2 and ("probably" in said.err or "longitudes" in said.err), said.err
    with pytest.raises(UsageError, match="xmin ymax xmax ymin, so 1 2 3 4 is meant"):
        pp.MapGrid.covering((1, 4, 3, 2), 0.1, CRS)
    for wrong in ("1,2,3,4", (1, 2, 3), None, (1, 2, 3, "x"), 5):
        with pytest.raises(UsageError, match="needed are four numbers, xmin ymin xmax ymax"):
            pp.MapGrid.covering(wrong, 0.1, CRS)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="finite"):
        pp.MapGrid.covering((1, 2, float("nan"), 4), 0.1, CRS)


def test_bounds_that_are_only_generous_are_kept(small: Block, tmp_path: Path) -> None:
    """Or lie beside all images: then the extents are told as before."""
    assert bounds_fault((0, 0, 1e6, 1e7), CRS, (5e5, 5.3e6, 5.001e5, 5.3002e6)) is None
    assert bounds_fault((-1000, -1000, 1000, 1000), None, (-10, -10, 20, 20)) is None
    assert bounds_fault((10, 10, 20, 20), None, (-10, -10, 0, 0)) is None
    said = inside("ortho", small.project, "--resolution", 2, "--dry-run", "--bounds", "1,2,3,4")
    assert said.code in (1, 3) and "no image sees terrain inside the bounds" in said.err


def test_a_project_file_names_the_order(small: Block) -> None:
    text, wrong = small.project.read_text().replace("[ortho]", ""), "[500400, 5300240, 500460, 5300180]"
    small.project.write_text(f"{text}\n[ortho]\nbounds = {wrong}\n")
    with pytest.raises(InputError, match="xmin ymax xmax ymin, so 500400 5300180 500460 5300240 is meant"):
        pp.load_project(small.project)
