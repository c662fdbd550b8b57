"""Commands made from requests: options, their sections, limits and messages; misspelt words; folders of projects."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
from tools.command import Here
from tools.small_block import Block

import photoplan as pp
from photoplan.cli.verb import Verb
from photoplan.errors import UsageError
from photoplan.request import OVERWRITE, Request, arg, opt


class Inner(Request):
    """A request in a request."""

    width: float = opt("Width of the thing, metres.", 1.0, gt=0, le=5)


class Outer(Request):
    """A request of every kind of option."""

    model: Path = arg("A model.")
    output: Path = opt("Raster to write.", metavar="TIF", writes=True)
    method: Literal["d8", "dinf"] = opt("How areas are summed.", "d8")
    bounds: tuple[float, float, float, float] | None = opt("Part.", None, section="input")
    scene: bool | None = opt("Side of the scene.", None, choices={"auto": None, "z<0": True})
    classes: tuple[float, ...] = opt("Limits.", (), listed=True, metavar="A,B")
    header: bool = opt("The first line is a point.", True, flag="no-header")
    inner: Inner = Inner()
    overwrite: bool = OVERWRITE


def test_values_are_checked_when_they_are_set() -> None:
    request = Outer("a.tif", output="b.tif", inner=Inner(width=2))
    assert (request.model, request.files_read(), request.files_written()["output"]) == (
        Path("a.tif"),
        [Path("a.tif")],
        [Path("b.tif")],
    )
    assert request.replace(method="dinf").inner.width == 2 and request == Outer(**dict(request))
    for values, says in (
        ({"inner": Inner}, "inner"),
        ({"method": "d9"}, r"`method` d9 must be one of d8 or dinf \(how areas are summed\)"),
        ({"bounds": (1, 2, 3)}, "3 values; needed are 4"),
        ({"width": 1}, "Outer has no option 'width'; its options are model, output"),
        ({"output": "a.tif", "model": "c"}, None),
        ({"output": Path("x/../b.tif")}, None),
    ):
        given = {"model": "a.tif", "output": "b.tif", **values}
        if says is None:
            Outer(**given)
            continue
        with pytest.raises(UsageError, match=says):
            Outer(**given)
    with pytest.raises(UsageError, match=r"`width` 6\.0 must be greater than 0 and at most 5 \(width of the thing"):
        Inner(width=6.0)
    with pytest.raises(UsageError, match="`output` is required"):
        Outer("a")


def test_two_outputs_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`output` and `preview` are the same file"):
        pp.ShadeRequest("m", output=tmp_path / "a.png", preview=tmp_path / "." / "a.png")


def test_options_of_the_command_come_from_the_fields() -> None:
    verb = Verb("Short.", "Long.", "x", "y")
    made: dict[str, object] = {}
    command = verb.command_of(Outer, "outer", lambda request, **_: made.update(request=request))
    words = [
        "m.tif",
        "-o",
        "o.tif",
        "--bounds",
        "1",
        "2",
        "3",
        "4",
        "--classes",
        "5,10",
        "--classes",
        "20",
        "--no-header",
        "--scene",
        "z<0",
        "--width",
        "3",
    ]
    command.main(words, standalone_mode=False)
    assert made["request"] == Outer(
        "m.tif",
        output="o.tif",
        bounds=(1, 2, 3, 4),
        scene=True,
        classes=(5, 10, 20),
        header=False,
        inner=Inner(width=3),
    )
    text = command.get_help(command.make_context("outer", ["m", "-o", "o"]))
    titles = [line for line in text.splitlines() if line.rstrip(":") in ("Input", "Result", "Method", "Run")]
    assert titles == ["Input:", "Result:", "Method:", "Run:"]
    assert text.index("Input:") < text.index("--bounds") < text.index("Result:") < text.index("--output")
    assert "[d8|dinf]" in text and "[default: d8]" in text and "--scene [auto|z<0]" in text


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("mosiac", "`photoplan mosaic`"),
        ("volume", "`photoplan dtm volume`"),
        ("dtm shad", "`photoplan dtm shade`"),
        ("qqq", "see `photoplan --help`"),
    ],
)
def test_misspelt_commands_are_named(photoplan: Here, words: str, meant: str) -> None:
    said = photoplan(*words.split())
    assert said.code == 2 and meant in said.err


def test_a_folder_stands_for_its_project(photoplan: Here, small: Block) -> None:
    said = photoplan("check", small.project.parent, "--json")
    assert said.code == 0 and said.out == photoplan("check", small.project, "--json").out
    assert pp.load_project(small.project.parent) == pp.load_project(small.project)
