"""Options that several verbs share, and how values are spelled."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from photoplan.events import Events
    from photoplan.products.run import Run

#: Endings of files: a folder of such a name would be made in silence.
_FILE = re.compile(r"\.(csv|gpkg|html|jp2|jpe?g|json|la[sz]|pdf|png|tiff?|toml|vrt)$", re.IGNORECASE)


class _Path(click.Path):
    """A path that is not empty, which would be the folder where the command runs; no new folder is named as a file."""

    def __init__(self, *, file_okay: bool = True, new_folder: bool = False) -> None:
        super().__init__(path_type=Path, file_okay=file_okay)
        self.new_folder = new_folder

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not str(value).strip():
            self.fail("the name is empty; give the name of a file or folder", param, ctx)
        if self.new_folder and _FILE.search(str(value)) and not Path(str(value)).exists():
            self.fail(f"{str(value)!r} is named as a file; give a folder: files in it have their own names", param, ctx)
        return super().convert(value, param, ctx)


class _ProjectPath(_Path):
    """A project file; a folder stands for the `project.toml` in it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = super().convert(value, param, ctx)
        inside = Path(path) / "project.toml"
        return inside if inside.is_file() else path


PATH = _Path()
PROJECT = _ProjectPath()
FOLDER = _Path(file_okay=False)
NEW_FOLDER = _Path(new_folder=True)
POSITIVE = click.FloatRange(0, min_open=True)


def several(*options: Callable[..., Any]) -> Callable[..., Any]:
    """Options (and arguments) as one decorator, in the order of the help."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


class _Bytes(click.ParamType):
    """A number of bytes such as 2GB, 512MiB or 1.5G (1 K = 1024)."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"\s*(\d{1,12}(?:\.\d{1,12})?)\s*([KMGT]?)(?:i?B)?\s*", str(value), re.IGNORECASE)
        if not match:
            self.fail(f"{value!r} is no size; write for example 2GB or 800MB", param, ctx)
        return int(float(match[1]) * _UNITS[match[2].upper()])


BYTES = _Bytes()


def all_cores(context: click.Context, parameter: click.Parameter, given: int | None) -> int:
    """Return the number of workers; all cores if none is given."""
    from photoplan.engine.executors import available_cpus

    return given or available_cpus()


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")
quiet_option = click.option("-q", "--quiet", is_flag=True, help="No progress on stderr; warnings stay.")
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what exists.")
workers_option = click.option(
    "--workers", type=click.IntRange(1), callback=all_cores, help="Worked on at once [all cores]."
)
executor_option = click.option(
    "--executor",
    default="threads",
    show_default=True,
    metavar="KIND",
    help="threads, processes, or a Dask scheduler's address tcp://host:port.",
)
memory_option = click.option("--memory", type=BYTES, default=None, metavar="SIZE", help="Stay under this, e.g. 2GB.")
bounds_option = click.option(
    "--bounds", type=float, nargs=4, default=None, metavar="XMIN YMIN XMAX YMAX", help="Part to make [all]."
)


beyond_area_option = click.option(
    "--beyond-area", is_flag=True, help="Accept coordinates far outside the area of use of their CRS."
)


def dry_run_option(what: str) -> Callable[..., Any]:
    """`--dry-run`, with what happens instead."""
    return click.option("--dry-run", is_flag=True, help=what)


def ending(
    dry_run: str = "", *, workers: bool = False, executor: bool = False, memory: bool = False, overwrite: bool = True
) -> Callable[..., Any]:
    """What the options of nearly every verb end with; `dry_run` says what happens instead."""
    first = [workers_option] * workers + [executor_option] * executor + [memory_option] * memory
    first += [dry_run_option(dry_run)] * bool(dry_run) + [overwrite_option] * overwrite
    return several(*first, json_option, quiet_option)


def listed(values: Sequence[str]) -> tuple[str, ...]:
    """Values with commas between them, or of an option that is repeated; a file that is there is one value."""
    parts = [[value] if Path(value).exists() else value.split(",") for value in values]
    return tuple(part.strip() for split in parts for part in split if part.strip())


#: Of an option that takes a list.
LISTED: dict[str, Any] = {"multiple": True, "callback": lambda context, parameter, values: listed(values)}


def images_option(default: str = "all", name: str = "images") -> Callable[..., Any]:
    """`--images A,B` or repeated, for verbs that choose among the images of a project."""
    return click.option(
        "--images", name, metavar="NAME,…", **LISTED, help=f"Images or patterns; may be repeated [{default}]."
    )


#: What may be chosen of orthophotos and mosaics.
product_options = several(
    images_option(),
    click.option("--resolution", type=float, metavar="R", help="Ground pixel in metres [the images' mean GSD]."),
    bounds_option,
    click.option("--kernel", help="nearest, bilinear, bicubic, bicubic-1 or lanczos3 [bicubic]."),
    click.option("--tolerance", type=float, metavar="PX", help="Largest residual; 0: every pixel strictly [0.02]."),
    click.option(
        "--hidden",
        help="What no image sees: show, nodata, or mark (second raster) [ortho: show; mosaic, --true: nodata].",
    ),
    click.option(
        "--fill-hidden",
        type=int,
        metavar="PX",
        help="Fill hidden holes up to PX wide and high, marked in NAME_sources.tif [0: they stay empty].",
    ),
    click.option("--accuracy", is_flag=True, default=None, help="Also a raster of standard deviations, a picture."),
    click.option("--compress", help="deflate, zstd, lzw, jpeg or none [deflate]."),
    click.option("--nodata", help="A number, mask, or auto: 0 for integers, NaN for floats [auto]."),
    click.option("--overviews/--no-overviews", default=None, help="Whether the file holds overviews [yes]."),
    click.option("--tile", type=int, metavar="PX", help="Side of a tile [512]."),
    click.option("-o", "--output", type=NEW_FOLDER, help="Folder of the products [PROJECT's folder/products]."),
    click.option(
        "--force", is_flag=True, help="Also of orientations with a FAULT, and finer than a quarter of the GSD."
    ),
    click.option("--plan", "plan_file", type=PATH, help="Write the plan (GeoPackage) and stop."),
    click.option("--show-quadtree", is_flag=True, help="With --plan or --dry-run: objects as squares, too."),
    dry_run_option("Compile the plan, print it, and stop."),
)


_PENALTIES = ("slant", "coarseness", "border", "occlusion", "sharpness")


#: How images are chosen, for verbs that make one product of many.
choosing_options = several(
    click.option(
        "--score", metavar="NAME=WEIGHT,…", **LISTED, help=f"Weights of {', '.join(_PENALTIES)} [1, 1, 1, 0.5, 0]."
    ),
    click.option("--prefer", metavar="NAME,…", **LISTED, help="Images that come first wherever they see the ground."),
    click.option(
        "--sources", is_flag=True, help="Also which image painted each pixel: NAME_sources.tif, NAME_seams.gpkg."
    ),
)


def weights(given: Sequence[str]) -> Any:
    """Weights of the score from NAME=WEIGHT."""
    from photoplan.plan.sources import Weights

    values: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            name = ""
        if name not in _PENALTIES:
            raise click.BadParameter(f"{text!r}; write NAME=WEIGHT with {', '.join(_PENALTIES)}", param_hint="--score")
    return Weights(**values)


#: The options of every verb that executes a plan.
executing = several(
    workers_option,
    executor_option,
    memory_option,
    overwrite_option,
    click.option("--no-quicklook", is_flag=True, help="No picture of the product."),
    json_option,
    quiet_option,
)


@dataclass(frozen=True)
class How:
    """The options of `executing`, as values."""

    workers: int
    executor: str
    memory: int | None
    overwrite: bool
    quicklook: bool
    as_json: bool
    quiet: bool

    @classmethod
    def from_options(cls, options: dict[str, Any]) -> How:
        """Take the options of `executing` out of the options of a verb."""
        names = ("workers", "executor", "memory", "overwrite", "as_json", "quiet")
        return cls(quicklook=not options.pop("no_quicklook"), **{name: options.pop(name) for name in names})

    def run(self, events: Events, again: bool = False) -> Run:
        """What is asked of a run, told to `events`."""
        from photoplan.plain import pick
        from photoplan.products.run import Run

        return Run(**pick(self, "workers", "executor", "memory", "overwrite", "quicklook"), events=events, again=again)
