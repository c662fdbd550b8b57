"""What `ortho` does with a plan that is not to be executed yet: show it, and write it for `photoplan run`."""

from __future__ import annotations

from pathlib import Path

from photoplan.cli.output import show, show_json
from photoplan.cli.running import How
from photoplan.events import Events
from photoplan.products.orthophoto.plan import OrthoPlan
from photoplan.products.orthophoto.plan_file import PlanFigures, check_plan_path, compile_figures, write_plan


def show_plan(plan: OrthoPlan, folder: Path, plan_file: Path | None, how: How, events: Events) -> None:
    """Compile every tile's geometry, print the figures, write the plan if asked."""
    if plan_file is not None:
        check_plan_path(plan_file, plan, how.overwrite)
    figures = compile_figures(plan, events)
    if plan_file is not None:
        write_plan(plan_file, plan, figures, folder, how.overwrite)
    if how.as_json:
        show_json(figures.json_of(plan), plan=plan_file)
        return
    show(plan)
    show(_sums(plan, figures))
    for line in plan.blind:
        show(f"  {'left out' if plan.of_objects else 'sees no terrain'}: {line}")
    if plan_file is not None:
        show(plan_file)


def _sums(plan: OrthoPlan, figures: PlanFigures) -> str:
    return (
        f"plan: {len(plan.products)} products, {figures.tiles} tiles, {figures.cells} cells, "
        f"worst anchor residual {figures.residual:.3g} px"
    )
