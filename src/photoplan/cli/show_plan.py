"""What `ortho` does with a plan that is not to be executed yet: show it, and write it for `photoplan run`."""

from __future__ import annotations

from pathlib import Path

from photoplan.cli.options import How
from photoplan.cli.output import can_draw, show, show_json
from photoplan.events import Events
from photoplan.io.store import together
from photoplan.products.orthophoto.plan import OrthoPlan
from photoplan.products.orthophoto.plan_file import PlanFigures, check_plan_path, compile_figures, write_plan
from photoplan.products.orthophoto.quadtree import PlanSquares, plan_squares


def show_plan(
    plan: OrthoPlan, folder: Path, plan_file: Path | None, how: How, events: Events, quadtree: bool = False
) -> None:
    """Compile every tile's geometry, print the figures, write the plan if asked, objects as squares too if asked."""
    squares = plan_squares(plan) if quadtree else None
    if plan_file is not None:
        check_plan_path(plan_file, plan, how.overwrite)
    figures = compile_figures(plan, events)
    with together():
        if plan_file is not None:
            write_plan(plan_file, plan, figures, folder, how.overwrite, squares)
        if plan_file is not None and squares is not None:
            _draw(plan, squares, plan_file.with_name(f"{plan_file.stem}_quadtree.png"), how, events)
    if how.as_json:
        more = {} if squares is None else {"quadtree": squares.counts}
        show_json(figures.json_of(plan), plan=plan_file, **more)
        return
    show(plan)
    show(_sums(plan, figures))
    for line in plan.blind:
        show(f"  left out: {line}")
    for line in [] if squares is None else [f"quadtree: {len(squares.bounds)} squares", *squares.lines]:
        show(line)
    if plan_file is not None:
        show(plan_file)


def _draw(plan: OrthoPlan, squares: PlanSquares, picture: Path, how: How, events: Events) -> None:
    """A picture of the squares of a plan's first product, or of all objects where each has its own."""
    from photoplan.report.maps import draw_squares

    if can_draw(how.quicklook, events.talk):
        # Products of images show the same objects again and again.
        own = (squares.columns["product"] == squares.columns["product"][0]) | plan.of_objects
        title = f"{own.sum()} squares of {len(set(squares.columns['object'][own]))} objects"
        events.talk(f"quadtree: drawn in {draw_squares(picture, squares.bounds[own], title)}")


def _sums(plan: OrthoPlan, figures: PlanFigures) -> str:
    return f"plan: {plan.what}, {figures.tiles} tiles, {figures.cells} cells, " + (
        f"worst anchor residual {figures.residual:.3g} px" if plan.settings.tolerance else plan.settings.exactness
    )
