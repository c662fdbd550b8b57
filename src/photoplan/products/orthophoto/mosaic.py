"""Mosaics and single objects: plans, regions, sheets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import project as into_image
from photoplan.engine.execute import render
from photoplan.errors import InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.files import safe_stem
from photoplan.io.project.model import Objects, Project
from photoplan.io.vector_layer import Regions, read_regions
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import ImageExtent, Tile, Tiles, covered_tiles
from photoplan.plan.product import ProductPlan
from photoplan.products.orthophoto.plan import (
    Looked,
    OrthoPlan,
    OrthoProduct,
    check_storable,
    chosen_settings,
    extent_text,
    grid_of,
    judge_bounds,
    keyed,
    look_at,
    product_plan,
    refuse_blind,
    with_resolution,
)
from photoplan.products.orthophoto.sheets import Sheet, drawn_sheets, sheets_of
from photoplan.quality.curves import BLOCK, blur_of, detail_energies, detail_quotients
from photoplan.requests.ortho import Choice, OrthoSettings
from photoplan.surfaces.objects import Faces, ObjectSurface, SingleObject, painted_surface
from photoplan.surfaces.polygon_faces import LEAST_AREA
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
    """Return True if a footprint reaches into a grid."""
    xmin, ymin, xmax, ymax = grid.bounds
    return bounds is not None and bounds[0] < xmax and bounds[2] > xmin and bounds[1] < ymax and bounds[3] > ymin


def drawn_regions(
    project: Project, settings: OrthoSettings, images: tuple[str, ...], grid: MapGrid, known: Sequence[str] = ()
) -> Regions | None:
    """Regions of the choice's file; None: it has none. Those of `known` images that are no sources are left out."""
    if settings.choice is None or settings.choice.seams is None:
        return None
    return read_regions(project.resolve(str(settings.choice.seams)), images, grid, known)


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
    return names, chosen.replace(choice=chosen.choice.replace(prefer=tuple(dict.fromkeys(order))))


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


def plan_objects(
    project: Project,
    images: Sequence[str] | None = None,
    settings: OrthoSettings | None = None,
    *,
    polygons: Objects,
    objects: Sequence[str] = (),
    below: bool = False,
    events: Events = SILENT,
    force: bool = False,
    **changes: Any,
) -> OrthoPlan:
    """Plan a product for each object of a file; no pixel is touched.

    Each shows its object alone, on the map, from the best image of those that see it: beside its outline and in its
    holes it is empty, and so it is where something hides the object in all images. Everything else of the file, of the
    project and the ground may hide it.

    Parameters
    ----------
    project, images, settings, events, force, **changes
        As of `plan_mosaic`; `bounds` cut what is made.
    polygons : Objects
        The file, as [[objects]] states it; an entry of the project for the same file says what is not stated. Features
        of one name are one object.
    objects : sequence of str
        Names, or patterns of names, of the objects to make; all if it is empty.
    below : bool
        Whether what lies below each object (the road under a bridge) is a product, too.

    Raises
    ------
    InputError
        An input cannot be used: objects that cross themselves, have no heights or lie below the ground are named.
    GeometryError
        No image sees an object, or an orientation cannot be right.
    UsageError
        An unknown image, object or setting, bounds that hold nothing, or a resolution that is much too fine.
    """
    chosen = chosen_settings(project, settings, {"choice": Choice(), "hidden": "nodata", **changes})
    project, entry = _with_file(project, polygons)
    names, chosen = with_preferred(project, images, chosen)
    events.begin("planning", len(names), "images")
    looked, blind = look_at(project, names, force, events)
    refuse_mixed(looked)
    chosen = with_resolution(chosen, looked, force)
    refuse_blind(chosen, looked, blind)
    judge_bounds(project, chosen, [one.look.footprint for one in looked])
    looked = with_blur(looked, grid_of(project, chosen, [one.look.footprint for one in looked]), chosen, events)
    surface = looked[0].scene.surface
    assert isinstance(surface, ObjectSurface)
    found = _placed(_named(surface, entry, objects), chosen, project.plane_crs, blind)
    near = _near(found, looked)
    products = []
    events.begin("planning objects", len(found), "objects")
    for one, among in zip(found, near):
        for wanted in (one, one.below()) if below else (one,):
            product = _product_objects(project, chosen, wanted, [looked[k] for k in among])
            products += [] if product is None else [product]
            if product is None and wanted is one:
                blind.append(f"object {one.name!r} lies in no image")
        events.done()
    refuse_blind(chosen, products, blind)
    return OrthoPlan(project, chosen, tuple(products), tuple(blind))


@dataclass(frozen=True, eq=False)
class _Single:
    """An object that gets a product, or what lies below it."""

    name: str
    surface: ObjectSurface
    """That shows nothing else."""
    grid: MapGrid

    def below(self) -> _Single:
        """Return the ground below it."""
        assert self.surface.part is not None
        return replace(self, surface=replace(self.surface, part=replace(self.surface.part, below=True)))

    @property
    def stem(self) -> str:
        """Name of its product."""
        return f"{safe_stem(self.name)}_{'below' if self.surface.shows_ground else 'object'}"

    @property
    def shown(self) -> ObjectSurface | Faces:
        """Surface with the heights of all that it shows."""
        faces = self.surface.shown
        return self.surface if faces is None or self.surface.shows_ground else faces


def _with_file(project: Project, polygons: Objects) -> tuple[Project, int]:
    """The project with the file among its objects, and the place of its entry."""
    path = project.resolve(polygons.file)
    stated = polygons.model_dump(exclude_none=True)
    for place, own in enumerate(project.objects):
        if project.resolve(own.file) == path and polygons.layer in (None, own.layer):
            entries = [*project.objects]
            entries[place] = own.model_copy(update={**stated, "file": own.file})
            return project.model_copy(update={"objects": tuple(entries)}), place
    return project.model_copy(update={"objects": (*project.objects, polygons)}), len(project.objects)


def _named(surface: ObjectSurface, entry: int, patterns: Sequence[str]) -> dict[str, ObjectSurface]:
    """The objects of a file that are asked for; features of one name are one."""
    places: dict[str, list[int]] = {}
    with_faces = set(surface.faces.owner.tolist())
    for place, name in enumerate(surface.faces.names):
        if surface.entries[place] == entry and place in with_faces:
            places.setdefault(name, []).append(place)
    chosen = [n for n in places if not patterns or any(n == p or fnmatchcase(n, p) for p in patterns)]
    for pattern in patterns:
        if not any(n == pattern or fnmatchcase(n, pattern) for n in chosen):
            known = ", ".join([*places][:5])
            raise UsageError(f"object {pattern!r} is not in the file; its {len(places)} objects begin with {known}")
    stems: dict[str, str] = {}
    for name in chosen:
        stem = safe_stem(name)
        if stem.casefold() in stems:
            raise UsageError(f"objects {stems[stem.casefold()]!r} and {name!r} would both be {stem!r}; rename one")
        stems[stem.casefold()] = name
    return {name: replace(surface, part=SingleObject(tuple(places[name]))) for name in chosen}


def _placed(
    found: Mapping[str, ObjectSurface], chosen: OrthoSettings, crs: str | None, blind: list[str]
) -> list[_Single]:
    """Objects with the grids of their products; of those that cover nothing of the map `blind` gets a line each."""
    assert chosen.resolution is not None
    placed = []
    for name, surface in found.items():
        assert surface.shown is not None
        corners = surface.shown.corners
        (ax, ay), (bx, by) = (np.moveaxis(corners[:, k, :2] - corners[:, 0, :2], -1, 0) for k in (1, 2))
        low, high = corners.min(axis=(0, 1)).tolist(), corners.max(axis=(0, 1)).tolist()
        own = (low[0], low[1], high[0], high[1])
        limit = chosen.bounds or own
        if np.abs(ax * by - ay * bx).sum() < 2 * LEAST_AREA:
            blind.append(f"object {name!r} stands upright: it covers nothing of the map")
        elif not (own[0] < limit[2] and limit[0] < own[2] and own[1] < limit[3] and limit[1] < own[3]):
            blind.append(f"object {name!r} lies in {extent_text(own)}; the bounds are {extent_text(limit)}")
        else:
            cut = (*np.maximum(own[:2], limit[:2]).tolist(), *np.minimum(own[2:], limit[2:]).tolist())
            placed.append(_Single(name, surface, MapGrid.covering(cut, chosen.resolution, crs)))
    return placed


def _near(found: Sequence[_Single], looked: Sequence[Looked]) -> list[list[int]]:
    """Places of the images into which each object, or the ground below it, can fall."""
    if not found:
        return []
    boxes = np.array([one.grid.bounds for one in found])
    ranges = found[0].surface.height_range(boxes)
    low, high = float(np.nanmin(ranges)), float(np.nanmax(ranges))
    near: list[list[int]] = [[] for _ in found]
    for place, each in enumerate(looked):
        view = ImageExtent.of(each.scene.camera, low, high)
        for k in [] if view is None else np.flatnonzero(view.sees(boxes, ranges)):
            near[k].append(place)
    return near


def _product_objects(
    project: Project, chosen: OrthoSettings, one: _Single, looked: Sequence[Looked]
) -> OrthoProduct | None:
    """The product of an object; None: it lies in no image."""
    levels = one.shown.height_range(np.array(one.grid.bounds)).tolist()
    tiles = [covered_tiles(each.scene.camera, one.shown, one.grid, chosen.tile) for each in looked]
    taking = [(each, mine) for each, mine in zip(looked, tiles) if len(mine)]
    if not taking:
        return None
    check_storable(taking[0][0].scene, one.stem, one.grid, chosen)
    # Between its own heights the score is interpolated.
    seen = [replace(each.look.footprint, height_range=(levels[0], levels[1])) for each, _ in taking]
    looks = tuple(replace(each.look, footprint=footprint) for (each, _), footprint in zip(taking, seen))
    shared, images = Tiles.shared([mine for _, mine in taking]), tuple(each.name for each, _ in taking)
    if chosen.fill_hidden:
        shared = shared.with_neighbours()
    plan = product_plan(one.stem, images, one.grid, shared, chosen, looks)
    return OrthoProduct(plan, looks, keyed(project, plan, chosen, one.surface.part), one.surface.part)
