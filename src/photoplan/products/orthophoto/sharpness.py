"""How sharp each image of a block shows the ground, compared with the others that show the same ground.

Patches of the product are resampled from every image that sees them. In each, what fine detail there is, is compared
with what is twice as coarse: the quotient of both does not know contrast and exposure. It knows the ground, which all
images of a patch have in common; so its logarithm is that of the patch plus that of the image, and medians tell both
apart, whatever single patches show (things that move, that lean). Noise is fine detail, too: what an image has of it in
its quietest places is taken off before.
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
from photoplan.targets.map import MapTarget

#: Least and largest side of a patch, pixels of the product.
_PATCH = (32, 64)
#: Side of the blocks in which the quietest places are sought, pixels.
_BLOCK = 8
#: Patches along the side of a footprint.
_ALONG = 8
#: The share of blocks that show noise alone.
_QUIET = 0.1
#: Images are judged by no fewer patches.
_LEAST = 3
_ROUNDS = 30


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


def blur_of(quotients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Blur of images (n,) from logarithms of quotients of patches and images (m, n); NaN where a patch is not shown."""
    seen = np.isfinite(quotients)
    # A patch that one image shows tells nothing of others.
    use = np.where(seen & (seen.sum(axis=1) > 1)[:, None], quotients, np.nan)
    sharp = np.zeros(use.shape[1])
    use[:, np.isfinite(use).sum(axis=0) < _LEAST] = np.nan
    known, rows = np.isfinite(use).any(axis=0), np.isfinite(use).any(axis=1)
    for _ in range(_ROUNDS if rows.any() else 0):
        ground = np.nanmedian(use[rows] - sharp, axis=1)
        sharp[known] = np.nanmedian(use[np.ix_(rows, known)] - ground[:, None], axis=0)
    sharp[~known] = sharp[known].max(initial=0.0)
    return np.asarray(sharp.max() - sharp)


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
        if made.values is not None and np.all(made.valid) and min(made.values.shape[1:]) >= 2 * _BLOCK:
            shown[place] = _energies(made.values.astype(float).mean(axis=0))
    out = np.full(len(sites), np.nan)
    if shown:
        blocks = np.concatenate([energy.reshape(2, -1) for energy in shown.values()], axis=1)
        noise = np.quantile(blocks, _QUIET, axis=1)
        for place, energy in shown.items():
            fine, coarse = energy.mean(axis=(1, 2)) - noise
            if fine > 0 and coarse > 0:
                out[place] = 0.5 * np.log2(fine / coarse)
    return out


def _energies(grey: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean squares of fine and of coarser detail in blocks of a patch, shape (2, rows, cols)."""
    once = _smooth(grey)
    twice = _smooth(once)
    fine, coarse = (grey[2:-2, 2:-2] - once)[2:-2, 2:-2], once[2:-2, 2:-2] - twice
    rows, cols = (size // _BLOCK for size in fine.shape)
    parts = np.square([fine, coarse])[:, : rows * _BLOCK, : cols * _BLOCK]
    return np.asarray(parts.reshape(2, rows, _BLOCK, cols, _BLOCK).mean(axis=(2, 4)))


def _smooth(grey: NDArray[np.float64]) -> NDArray[np.float64]:
    """Binomial means of five pixels along both axes; two pixels less on every side."""
    for _ in range(2):
        grey = (grey[:-4] + grey[4:] + 4 * (grey[1:-3] + grey[3:-1]) + 6 * grey[2:-2]).T / 16
    return grey
