"""Pictures of products, views and error budgets, and the page of a project."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from photoplan.events import SILENT, Events
from photoplan.products.budget import PLACES, Budget, SourceTables
from photoplan.products.orthophoto.finished import ProductResult, seams_path
from photoplan.products.report import MOST_ROWS, ProjectReport
from photoplan.products.view.make import view_picture
from photoplan.products.view.sequence import view_sequence
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    figure_of,
    findings_section,
    headline,
    lettering,
    page,
    png,
    section,
    shortened,
    styled,
    table,
    text,
)
from photoplan.requests.view import PictureOptions, SequenceRequest, ViewRequest


def draw_product(part: Any, request: Any, can_draw: Callable[[bool], bool]) -> Iterator[str]:
    """Draw what was asked for of a product or plan, and return what there is to say of it.

    Drawings are imported here alone, since most products have none.
    """
    if not isinstance(part, ProductResult):
        if getattr(part, "squares", None) is not None and part.path is not None and can_draw(request.quicklook):
            from photoplan.report.maps import draw_squares  # noqa: PLC0415

            # Products of images show the same objects again and again.
            columns = part.squares.columns
            own = (columns["product"] == columns["product"][0]) | part.plan.of_objects
            title = f"{own.sum()} squares of {len(set(columns['object'][own]))} objects"
            picture = part.path.with_name(f"{part.path.stem}_quadtree.png")
            yield f"quadtree: drawn in {draw_squares(picture, part.squares.bounds[own], title)}"
        return
    if part.accuracy is not None and not part.failed:
        raster, drawn = part.path.with_name(f"{part.path.stem}_accuracy.tif"), ""
        if can_draw(request.quicklook):
            from photoplan.report.maps import draw_accuracy  # noqa: PLC0415

            drawn = f", drawn in {draw_accuracy(raster)}"
        figures = "median {median:.3g} m, 95 % of the pixels below {p95:.3g} m".format(**part.accuracy)
        yield f"standard deviation of position: {figures}: {raster}{drawn}"
    if (regions := seams_path(part.path)) in part.written():
        drawn = ""
        if can_draw(True):
            from photoplan.io.vector_layer import read_features  # noqa: PLC0415
            from photoplan.report.maps import draw_regions  # noqa: PLC0415

            shapes = {item.name: item.geometry for item in read_features(regions, "Polygon").items}
            of = f"{len(part.painted or {})} images paints, of {len(part.images)} that see the ground"
            title = f"{part.path.name}: what each of {of}"
            drawn = f", drawn in {draw_regions(regions.with_suffix('.png'), shapes, title)}"
        yield f"regions: {regions}{drawn}"


def project_page(made: ProjectReport) -> str:
    """Return the report as one document."""
    old = sum(bool(each.old) for each in made.records)
    head = headline(
        [
            (
                str(len(made.records)),
                "run record" if len(made.records) == 1 else "run records",
                f"{old} of them old" if old else "all of the project as it is",
            ),
            (str(len(made.warnings)), "warning" if len(made.warnings) == 1 else "warnings", ""),
            (str(len(made.missing)), "gap" if len(made.missing) == 1 else "gaps", ", ".join(made.missing)),
        ]
    )
    rows = [
        *(("warning", each) for each in made.warnings),
        *(("missing", f"{what}: {why}") for what, why in made.missing.items()),
        *(("note", each) for each in made.notes),
    ]
    parts = [table(("kind", "message"), rows)] if rows else [f"<p>{text('None.')}</p>"]
    sources = [(each.name, each.path.name, each.when) for each in made.records]
    return page(
        f"Quality report: {made.title}",
        f"From {made.project.name} and the records of its runs",
        [
            head,
            section("Warnings, gaps and notes", parts),
            *(findings_section(each, MOST_ROWS) for each in made.sections),
            section("Source files", [table(("result", "run record", "finished"), sources)]) if sources else "",
        ],
    )


def labelled_picture(request: ViewRequest, events: Events = SILENT) -> Any:
    """Make a picture with the labels of its lines; see `view_picture`."""
    return view_picture(request.replace(**_letters(request)), events)


def labelled_sequence(request: SequenceRequest, events: Events = SILENT) -> Any:
    """Make pictures along a path with the labels of their lines; see `view_sequence`."""
    return view_sequence(request.replace(**_letters(request)), events)


def _letters(request: PictureOptions) -> dict[str, Any]:
    labels = any("label" in dict(each.options) for each in request.lines)
    return {"lettering": lettering(request.text_size)} if labels else {}


#: Contributions that are nowhere larger than this part of the total are not drawn.
_LEAST = 0.05
_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, SOFT)


@styled
def draw_picture(found: Budget | SourceTables) -> bytes | None:
    """Draw bars for each place, and the map of the total over the typical image; nothing for tables."""
    if isinstance(found, SourceTables):
        return None
    budget = found.typical
    fig = figure_of(8.6, 3.6)
    bars, area = fig.subplots(1, 2, width_ratios=(1.25, 1))
    places = np.arange(len(PLACES))
    drawn = {n: v for n, v in budget.parts.items() if (v > _LEAST * budget.total).any()}
    wide = 0.8 / (len(drawn) + 1)
    for k, (name, values) in enumerate(drawn.items()):
        bars.bar(places - 0.4 + (k + 0.5) * wide, values, wide * 0.9, label=name,
                 color=_COLOURS[k % len(_COLOURS)], hatch="//" * (k // len(_COLOURS)))  # fmt: skip
    bars.bar(places + 0.4 - 0.5 * wide, budget.total, wide * 0.9, label="total", color=INK)
    bars.set(xticks=places, xticklabels=PLACES, ylabel="standard deviation of position, m")
    bars.set_title(f"{shortened(budget.image, 30)}: contributions")
    bars.grid(axis="x", visible=False)
    bars.legend(fontsize=8, loc="upper left")
    shown = area.imshow(budget.map, cmap="cividis", extent=(0, 1, 1, 0), interpolation="bilinear")
    lines = area.contour(np.linspace(0, 1, budget.map.shape[1]), np.linspace(0, 1, budget.map.shape[0]),
                         budget.map, 5, colors="white", linewidths=0.7)  # fmt: skip
    area.clabel(lines, fmt="%.3g", fontsize=7)
    area.set(xticks=[], yticks=[], xlabel="over the image")
    area.set_title("total, m")
    fig.colorbar(shown, ax=area, shrink=0.9)
    return png(fig)
