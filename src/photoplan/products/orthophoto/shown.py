"""Ground that single images show where nothing hides it: in memory, at a coarse resolution."""

from __future__ import annotations

from photoplan.engine.execute import Painted, render
from photoplan.geometry.grid import MapGrid, Window
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Tile, Tiles
from photoplan.plan.product import ProductPlan
from photoplan.plan.sources import InSight
from photoplan.project.scene import Scene
from photoplan.targets.map import MapTarget

_KERNEL, _TOLERANCE = "bilinear", 0.5


def shown(scene: Scene, grid: MapGrid, window: Window, side: int) -> Painted:
    """Return what an image shows of a window of a map whose tiles have a side; nothing where the ground is hidden."""
    rule = AnchorRule.of(_KERNEL, _TOLERANCE)
    plan = ProductPlan(
        name="shown",
        sources=("image",),
        target=MapTarget(grid),
        rule=rule,
        tiles=Tiles.every(grid.window, side),
        owners=InSight(),
    )
    return render(plan, Tile(0, window, (0,)), scene.sources, scene.surface, _KERNEL)
