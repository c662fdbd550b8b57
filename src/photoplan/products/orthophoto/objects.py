"""Products of single objects: what each looks like from above, without what is around it (Behr 1989, §6.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.grid import MapGrid
from photoplan.io.names import safe_stem
from photoplan.io.project.model import Objects, Project
from photoplan.plan.footprint import ImageExtent, covered_tiles
from photoplan.plan.tiles import Tiles
from photoplan.products.orthophoto.keys import keyed
from photoplan.products.orthophoto.look import Looked, extent_text, look_at, with_resolution
from photoplan.products.orthophoto.mosaic import refuse_mixed, with_preferred
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
from photoplan.surfaces.faces import Faces
from photoplan.surfaces.objects import ObjectSurface, SingleObject
from photoplan.surfaces.polygon_faces import LEAST_AREA


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
    found = _placed(_named(surface, entry, objects), chosen, project.crs, blind)
    near = _near(found, looked)
    products = []
    events.begin("planning objects", len(found), "objects")
    for one, among in zip(found, near):
        for wanted in (one, one.below()) if below else (one,):
            product = _product(project, chosen, wanted, [looked[k] for k in among])
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
        """What lies below it."""
        assert self.surface.part is not None
        return replace(self, surface=replace(self.surface, part=replace(self.surface.part, below=True)))

    @property
    def stem(self) -> str:
        """Name of its product."""
        return f"{safe_stem(self.name)}_{'below' if self.surface.shows_ground else 'object'}"

    @property
    def shown(self) -> ObjectSurface | Faces:
        """What knows the heights of all that it shows."""
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


def _placed(found: Mapping[str, ObjectSurface], chosen: OrthoSettings, crs: str, blind: list[str]) -> list[_Single]:
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


def _product(project: Project, chosen: OrthoSettings, one: _Single, looked: Sequence[Looked]) -> OrthoProduct | None:
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
