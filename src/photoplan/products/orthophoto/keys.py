"""What decides the pixels of a product, and of each of its tiles: digests of that, and of nothing else."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from functools import cache
from typing import Any

from photoplan import __version__
from photoplan.engine.holes import halo
from photoplan.geometry.grid import Window
from photoplan.io.project.model import Project
from photoplan.plan.accuracy import in_image
from photoplan.plan.choice import BestImage, Drawn
from photoplan.plan.product import ProductPlan
from photoplan.products.orthophoto.settings import Choice, OrthoSettings
from photoplan.project.scenes import ScenesAddress
from photoplan.project.uncertain import ScenesErrors
from photoplan.surfaces.objects import SingleObject
from photoplan.targets.map import MapTarget


def keyed(project: Project, plan: ProductPlan, settings: OrthoSettings, part: SingleObject | None = None) -> str:
    """Key of a product of a project, or of what it shows of a single object."""
    address = ScenesAddress.of(project, plan.sources, part)
    facts = address.facts if not settings.accuracy else [address.facts, known_errors(address, plan, settings).facts]
    drawn = None
    if settings.choice is not None and isinstance(plan.owners, BestImage) and plan.owners.drawn is not None:
        assert isinstance(plan.target, MapTarget)
        around = halo(plan.fill_hidden) * plan.target.grid.resolution if plan.fill_hidden else 0.0
        drawn = plan.owners.drawn.digest(settings.choice.feather + around)
    return product_key(facts, plan, settings, drawn)


def known_errors(address: ScenesAddress, plan: ProductPlan, settings: OrthoSettings) -> ScenesErrors:
    """What is known of the errors of a product's images and of its ground."""
    sigma = in_image(settings.kernel, plan.rule.tolerance)
    return ScenesErrors(address, (sigma,) * len(address.scenes))


def tile_keys(address: ScenesAddress, plan: ProductPlan, settings: OrthoSettings) -> Callable[[int], str | None]:
    """Key of a tile of a mosaic by its index; None: it is none of the plan's tiles.

    Other than the key of the product it changes only with what the tile itself is made of: the images that can paint
    it, and the regions and lines in it and as far around it as seams are felt. What moves nothing but pixels elsewhere
    leaves it alone.
    """
    best = plan.owners
    assert isinstance(best, BestImage)
    common = _common(plan, settings)
    if settings.choice is not None:
        common |= {"choice": _facts(settings.choice, None) | {"prefer": None}, "levels": best.levels}
    if settings.accuracy:
        common |= {"errors": known_errors(address, plan, settings).facts}
    shared = _digest(common)
    scenes = [_digest(facts) for facts in address.facts]

    @cache
    def key(index: int) -> str | None:
        place = int(plan.tiles.indices.searchsorted(index))
        if place == len(plan.tiles) or plan.tiles.indices[place] != index:
            return None
        tile = plan.tiles[place]
        at, reach = tile.window, halo(plan.fill_hidden) if plan.fill_hidden else 0
        filled = Window(at.col - reach, at.row - reach, at.width + 2 * reach, at.height + 2 * reach)
        wide = filled if plan.feather is None else plan.feather.around(filled)
        images = [(row, scenes[row], best.ranks[row] if best.ranks else 0.0) for row in tile.sources]
        return _digest([shared, index, images, _rows(best.drawn, wide), _rows(plan.clip, tile.window)])[:32]

    return key


def _rows(drawn: Drawn | None, window: Window) -> str | None:
    """Of what is drawn in a window of a product."""
    return None if drawn is None else hashlib.sha256(drawn.rows(window).tobytes()).hexdigest()


def product_key(scenes: Any, plan: ProductPlan, settings: OrthoSettings, regions: str | None = None) -> str:
    """Hash of what decides a product's pixels, and of nothing else.

    Another key means that finished tiles are of no use.
    """
    facts = {
        **_common(plan, settings),
        "scene": scenes,
        "choice": None if settings.choice is None else _facts(settings.choice, regions),
        **({} if plan.clip is None else {"clip": plan.clip.digest(0.0)}),
    }
    return _digest(facts)


def _common(plan: ProductPlan, settings: OrthoSettings) -> dict[str, Any]:
    """What all tiles of a product depend on, whatever its images."""
    assert isinstance(plan.target, MapTarget)
    grid = plan.target.grid
    return {
        "version": __version__,
        "grid": [grid.left, grid.top, grid.resolution, grid.width, grid.height, grid.crs],
        "rule": [plan.rule.tolerance, plan.rule.radius, plan.tiles.side],
        "kernel": settings.kernel,
        "nodata": settings.nodata,
        "hidden": settings.hidden,
        "method": [settings.method, settings.fill],
        **({"fill_hidden": settings.fill_hidden} if settings.fill_hidden else {}),
    }


def _digest(facts: Any) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _facts(choice: Choice, regions: str | None) -> dict[str, Any]:
    """What of a choice decides pixels: of files what they say, not their names."""
    return {**asdict(choice), "name": "", "seams": regions, "sheets": None}
