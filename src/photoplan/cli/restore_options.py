"""Options that say where the filter of `photoplan restore` comes from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from photoplan.products.restore.filter import FilterRequest

_OPTIONS = (
    click.option("--filter", "filter_file", type=click.Path(path_type=Path), metavar="FILE|none",
                 help="TOML, or one kernel as rows of numbers; none: no filter [measured at edges of the images]."),
    click.option("--aperture", metavar="SHAPE[:RATIO]",
                 help="Undo a scanner's aperture: square or round, RATIO of aperture by step [1]."),
    click.option("--method", type=click.Choice(["auto", "exact", "regularised"]), default="auto", show_default=True,
                 help="Of a measured filter; auto: exact where that is possible and noise allows."),
    click.option("--rotation", type=click.Choice(["radial", "separable"]), default="radial", show_default=True,
                 help="How an exact inverse becomes two-dimensional."),
    click.option("--size", type=click.IntRange(3, 101), metavar="N", help="Side of a measured filter [11 or more]."),
    click.option("--most-noise-gain", type=click.FloatRange(1.0, 100.0), default=6.0, show_default=True, metavar="G",
                 help="Up to which auto takes an exact inverse."),
    click.option("--cells", type=click.IntRange(1, 15), default=1, show_default=True, metavar="N",
                 help="Filters for N by N parts of the field, interpolated between them."),
    click.option("--per-band", is_flag=True, help="A measured filter for each band."),
    click.option("--least-length", type=click.FloatRange(8.0, 10_000.0), metavar="PX", help="Of an edge [20]."),
    click.option("--save-filter", type=click.Path(path_type=Path), metavar="FILE.toml",
                 help="Where a measured filter is kept [restoration_filter.toml by the results]."),
)  # fmt: skip
#: Options that a measurement alone can follow.
_MEASURED = ("method", "rotation", "size", "most_noise_gain", "cells", "per_band", "least_length", "save_filter")


def filter_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options to a command."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def filter_request(images: tuple[Path, ...], options: dict[str, Any]) -> FilterRequest:
    """What the options ask for; takes them out of `options`, but for those that others need too."""
    from photoplan.products.restore.design import DesignRequest
    from photoplan.products.restore.filter import FilterRequest
    from photoplan.quality.restoration.design import DesignOptions

    file, aperture = options.pop("filter_file"), options.pop("aperture")
    asked = {name: options.pop(name) for name in _MEASURED if name != "save_filter"}
    if file is not None or aperture is not None:
        _refuse_measuring("--filter" if file is not None else "--aperture")
        none = file == Path("none")
        return FilterRequest(None if none else file, aperture, none=none)
    size = asked["size"]
    if size is not None and size % 2 == 0:
        raise click.UsageError(f"--size {size}: a filter has an odd number of rows and columns")
    design = DesignOptions(
        asked["method"], asked["rotation"], None if size is None else size // 2, asked["most_noise_gain"]
    )
    return FilterRequest(
        design=DesignRequest(
            images,
            _stated("linearisation", options),
            asked["per_band"],
            asked["cells"],
            least_length=asked["least_length"],
            options=design,
        )
    )


def _stated(name: str, options: dict[str, Any]) -> Any:
    """The value of an option that was given; None if it has its default."""
    given = click.get_current_context().get_parameter_source(name) is not click.core.ParameterSource.DEFAULT
    return options[name] if given else None


def _refuse_measuring(given: str) -> None:
    """Refuse options of a measurement where the filter is given."""
    context = click.get_current_context()
    for name in _MEASURED:
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--{name.replace('_', '-')} is for filters that are measured; leave out {given}")
