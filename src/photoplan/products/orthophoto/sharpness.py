"""How sharp each image of a block shows the ground, compared with the others that show the same ground.

Patches of the product are resampled from every image that sees them, and judged by `quality.relative_sharpness`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import project as into_image
from photoplan.engine.execute import render
from photoplan.events import Events
from photoplan.geometry.grid import MapGrid, Window
from photoplan.plan.compile import AnchorRule
from photoplan.plan.product import ProductPlan
from photoplan.plan.tiles import Tile, Tiles
from photoplan.products.orthophoto.look import Looked
from photoplan.products.orthophoto.settings import OrthoSettings
from photoplan.quality.relative_sharpness import BLOCK, blur_of, detail_energies, detail_quotients
from photoplan.targets.map import MapTarget

#: Least and largest side of a patch, pixels of the product.
_PATCH = (32, 64)
#: Patches along the side of a footprint.
_ALONG = 8


def with_blur(looked: Sequence[Looked], grid: MapGrid, settings: OrthoSettings, events: Events) -> list[Looked]:
    """Images with their blur, `Look.blur`, measured if the score asks for it.

    Images that share no ground with others, or show too little of it, count as sharp as the sharpest.
    """
    if settings.choice is None or not settings.choice.weights.sharpness:
        return list(looked)
    sites = _sites(looked, grid)
    events.begin("measuring sharpness", len(looked), "images")
    quotients = np.full((len(sites), len(looked)), np.nan)
    for column, one in enumerate(looked):
        quotients[:, column] = _quotients(one, sites, grid, settings)
        events.done()
    blur = blur_of(quotients)
    worst = int(np.argmax(blur))
    events.talk(
        f"sharpness: of {int(np.isfinite(quotients).any(axis=1).sum())} patches; {looked[worst].name!r} shows least of "
        f"the fine detail, {100 * 2.0 ** -blur[worst]:.0f} % of what the sharpest shows"
    )
    return [replace(one, look=replace(one.look, blur=b)) for one, b in zip(looked, blur.tolist())]


def _sites(looked: Sequence[Looked], grid: MapGrid) -> list[Window]:
    """Patches at equal distances over the product."""
    bounds = np.array([one.look.footprint.bounds for one in looked], float)
    side = float(np.median(np.sqrt(np.prod(bounds[:, 2:] - bounds[:, :2], axis=1)))) / grid.resolution
    patch = round(min(max(side / _ALONG, _PATCH[0]), _PATCH[1]))
    across, down = (
        range(0, max(1, size - patch + 1), max(patch, round(side / _ALONG))) for size in (grid.width, grid.height)
    )
    return [Window(col, row, patch, patch) & grid.window for row in down for col in across]


def _quotients(one: Looked, sites: Sequence[Window], grid: MapGrid, settings: OrthoSettings) -> NDArray[np.float64]:
    """For each patch that the image shows as a whole, the logarithm to base 2 of fine by coarser detail."""
    target, scene = MapTarget(grid), one.scene
    rule = AnchorRule.of(settings.kernel, settings.tolerance)
    plan = ProductPlan(
        name=one.name, sources=(one.name,), target=target, rule=rule, tiles=Tiles.every(grid.window, settings.tile)
    )
    shown: dict[int, NDArray[np.float64]] = {}
    for place, window in enumerate(sites):
        corners = np.array([(0.0, 0), (1, 0), (0, 1), (1, 1), (0.5, 0.5)]) * (window.width, window.height)
        XY = grid.to_map(corners + np.array([window.col, window.row]))
        xy = into_image(scene.camera, np.concatenate([XY, scene.surface.heights(XY)[:, None]], axis=1))
        if not ((xy > 0) & (xy < np.array(scene.camera.size) - 1)).all():
            continue
        made = render(plan, Tile(0, window), scene.sources, scene.surface, settings.kernel)
        if made.values is not None and np.all(made.valid) and min(made.values.shape[1:]) >= 2 * BLOCK:
            shown[place] = detail_energies(made.values.astype(float).mean(axis=0))
    out = np.full(len(sites), np.nan)
    out[list(shown)] = detail_quotients(list(shown.values()))
    return out
