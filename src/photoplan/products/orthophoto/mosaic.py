"""One orthophoto of many images: each pixel from the best of those that see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import MapGrid
from photoplan.io.names import safe_stem
from photoplan.io.project.model import Project
from photoplan.io.regions import Regions, read_regions
from photoplan.plan.footprint import covered_tiles
from photoplan.plan.tiles import Tiles
from photoplan.products.orthophoto.keys import keyed
from photoplan.products.orthophoto.look import Looked, look_at, with_resolution
from photoplan.products.orthophoto.plan import (
    OrthoPlan,
    OrthoProduct,
    check_storable,
    chosen_settings,
    grid_of,
    judge_bounds,
    product_plan,
    refuse_blind,
)
from photoplan.products.orthophoto.settings import Choice, OrthoSettings
from photoplan.products.orthophoto.sharpness import with_blur
from photoplan.products.orthophoto.sheets import Sheet, drawn_sheets, sheets_of
from photoplan.surfaces.objects import painted_surface


def plan_mosaic(
    project: Project,
    images: Sequence[str] | None = None,
    settings: OrthoSettings | None = None,
    *,
    events: Events = SILENT,
    force: bool = False,
    **changes: Any,
) -> OrthoPlan:
    """Plan one orthophoto of many images; no pixel is touched but those that sharpness is measured in, if it counts.

    Parameters
    ----------
    project, images, settings, events, force, **changes
        As of `plan_orthophotos`; `choice` says how images are chosen, and what no image sees is left empty unless
        `hidden` is given.

    Raises
    ------
    InputError
        An input cannot be used, or images differ in bands or type of pixels.
    GeometryError
        No image sees the terrain, or an orientation cannot be right.
    UsageError
        An unknown image or setting, bounds that hold nothing, or a resolution that is much too fine.
    """
    chosen = chosen_settings(project, settings, {"choice": Choice(), "hidden": "nodata", **changes})
    names, chosen = with_preferred(project, images, chosen)
    events.begin("planning", len(names), "images")
    looked, blind = look_at(project, names, force, events)
    refuse_mixed(looked)
    chosen = with_resolution(chosen, looked, force)
    refuse_blind(chosen, looked, blind)
    judge_bounds(project, chosen, [one.look.footprint for one in looked])
    grid = grid_of(project, chosen, [one.look.footprint for one in looked])
    looked = with_blur(looked, grid, chosen, events)
    assert chosen.choice is not None
    name, size = safe_stem(chosen.choice.name), chosen.choice.sheets
    if isinstance(size, str):
        parts = drawn_sheets(grid, project.resolve(size))
    else:
        parts = [Sheet("", grid)] if size is None else sheets_of(grid, size)
    events.begin("finding tiles", len(looked) * len(parts), "images")
    found = [_product(project, chosen, looked, names, name, part, events) for part in parts]
    products = tuple(each for each in found if each is not None)
    drawn = drawn_regions(project, chosen, tuple(names), grid)
    if drawn is not None and not drawn.meet:
        events.talk(
            f"warning: {chosen.choice.seams}: none of its regions lies in the mosaic; look at their place and CRS"
        )
    seen = {image for each in products for image in each.images}
    blind += [f"{one.name}: sees nothing inside the bounds" for one in looked if one.name not in seen]
    refuse_blind(chosen, products, blind)
    return OrthoPlan(project, chosen, products, tuple(blind))


def _product(
    project: Project,
    chosen: OrthoSettings,
    looked: Sequence[Looked],
    every: Sequence[str],
    name: str,
    sheet: Sheet,
    events: Events,
) -> OrthoProduct | None:
    """Return a mosaic, or a sheet, of the images that see a part of it; None if none does. `every` has also others."""
    assert chosen.choice is not None
    name, grid = name + sheet.end, sheet.grid
    # Whose seams lie beside a tile decides about weights in it, and who sees what is there about holes in it: also
    # beyond the product.
    side = chosen.tile if chosen.choice.feather or chosen.fill_hidden else 0
    margin = side * grid.resolution
    wide = MapGrid(
        left=grid.left - margin,
        top=grid.top + margin,
        resolution=grid.resolution,
        width=grid.width + 2 * side,
        height=grid.height + 2 * side,
        crs=grid.crs,
    )
    taking, tiles = [], []
    for one in looked:
        bounds, surface = one.look.footprint.bounds, painted_surface(one.scene.surface)
        mine = covered_tiles(one.scene.camera, surface, wide, chosen.tile, bounds) if _meet(bounds, wide) else ()
        if isinstance(mine, Tiles) and len(mine):
            taking.append(one)
            tiles.append(mine)
        events.done()
    if not taking:
        return None
    shared = Tiles.shared(tiles)
    if side:
        shared = shared.with_neighbours().inner()
    if not len(shared):
        return None
    check_storable(taking[0].scene, name, grid, chosen)
    taken = tuple(one.name for one in taking)
    looks = tuple(one.look for one in taking)
    regions = drawn_regions(project, chosen, taken, grid, every)
    plan = replace(product_plan(name, taken, grid, shared, chosen, looks, regions), clip=sheet.clip)
    return OrthoProduct(plan, looks, keyed(project, plan, chosen))


def _meet(bounds: tuple[float, float, float, float] | None, grid: MapGrid) -> bool:
    """Whether a footprint reaches into a grid."""
    xmin, ymin, xmax, ymax = grid.bounds
    return bounds is not None and bounds[0] < xmax and bounds[2] > xmin and bounds[1] < ymax and bounds[3] > ymin


def drawn_regions(
    project: Project, settings: OrthoSettings, images: tuple[str, ...], grid: MapGrid, known: Sequence[str] = ()
) -> Regions | None:
    """Regions of the choice's file; None: it has none. Those of `known` images that are no sources are left out."""
    if settings.choice is None or settings.choice.seams is None:
        return None
    return read_regions(project.resolve(settings.choice.seams), images, grid, known)


def with_preferred(
    project: Project, images: Sequence[str] | None, chosen: OrthoSettings
) -> tuple[list[str], OrthoSettings]:
    """Names of the images among which is chosen, and settings that name the preferred ones without patterns."""
    assert chosen.choice is not None
    names = project.select(images)
    order = [name for pattern in chosen.choice.prefer for name in project.select([pattern])]
    apart = [name for name in order if name not in names]
    if apart:
        raise UsageError(f"image {apart[0]!r} is preferred, but not among the images of the mosaic")
    return names, replace(chosen, choice=replace(chosen.choice, prefer=tuple(dict.fromkeys(order))))


def refuse_mixed(looked: Sequence[Looked]) -> None:
    """Refuse images that cannot lie in one file."""
    kinds: dict[tuple[int, str], str] = {}
    for one in looked:
        kinds.setdefault((one.scene.reader.bands, str(one.scene.reader.dtype)), one.name)
    if len(kinds) > 1:
        told = ", ".join(f"{name!r} has {bands} bands of {dtype}" for (bands, dtype), name in kinds.items())
        raise InputError(
            f"the images of a mosaic have the same bands and type of pixels: {told}; choose among them by `images`"
        )
