"""Plans of orthophotos: keys, coverage of images, bounds, tiles."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.cameras.base import Camera, on_level
from photoplan.engine.direct import Direct
from photoplan.engine.execute import MOST_IMAGES, Painted, halo, joined, with_holes_filled
from photoplan.engine.execute import render as render_tile
from photoplan.errors import GeometryError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.bounds import bounds_fault
from photoplan.geometry.grid import MapGrid, Window, refuse_absurd
from photoplan.io.disk import nodata_for
from photoplan.io.project.model import Project
from photoplan.orientation.conventions import ImagePlausibility, JudgedView
from photoplan.plain import advised, counted, plain
from photoplan.plan.accuracy import in_image
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Footprint, Tile, Tiles, covered_tiles, image_border, mean_gsd, some_height
from photoplan.plan.product import ProductPlan
from photoplan.plan.sources import BestImage, Drawn, InSight, feather_of
from photoplan.products.plausibility import judged, reading_of_block
from photoplan.project.error_model import ScenesErrors
from photoplan.project.scene import Scene, ScenesAddress, map_order, open_scene
from photoplan.requests.ortho import Choice, OrthoSettings
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import SingleObject, as_if_in_feet, painted_surface
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
    """Return what is known of the errors of a product's images and of its ground."""
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
    """Return the digest of what is drawn in a window of a product."""
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
    """Return what all tiles of a product depend on, whatever its images."""
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
    """Return the parts of a choice that decide pixels: the contents of files, not their names."""
    return {**plain(choice), "name": "", "seams": regions, "sheets": None}


#: A product is at most so many times finer than its images see the ground.
_FINER = 4.0


@dataclass(frozen=True, eq=False)
class Look:
    """View of an image on the terrain."""

    footprint: Footprint
    """Place of what it sees."""
    gsd: float
    """Its mean ground sampling distance, metres."""
    blur: float = 0.0
    """Powers of two by which its fine detail, beside the coarser, is weaker than that of the sharpest image of the
    same ground; 0 where nobody has asked."""


@dataclass(frozen=True, eq=False)
class Looked:
    """An image that sees terrain."""

    name: str
    scene: Scene
    look: Look


def look_at(project: Project, names: Sequence[str], force: bool, events: Events) -> tuple[list[Looked], list[str]]:
    """Oriented images that see terrain, and a line for each of the others."""
    names, blind = project.oriented(names, approximate=force)
    events.done(len(blind))
    scenes: dict[str, Scene] = {}
    seen: dict[str, tuple[JudgedView | None, ImagePlausibility]] = {}
    for place in map_order(project, names):
        # All that is asked of the terrain for one image, before the next: its blocks are then at hand.
        scenes[names[place]] = scene = open_scene(project, names[place])
        if scene.footprint.bounds is not None and project.target is None:
            seen[names[place]] = judged(project, project.any_image(names[place]), scene.ground)
        events.done()
    if not force and project.target is None:
        _refuse_faults(project, seen, scenes)
        _refuse_feet(list(scenes.values()))
    looked = []
    for name, scene in ((name, scenes[name]) for name in names):
        if scene.footprint.bounds is None:
            blind.append(_sees_no_terrain(scene, name) if project.target is None else _sees_no_target(scene, name))
        else:
            looked.append(Looked(name, scene, Look(scene.footprint, mean_gsd(scene.camera, scene.footprint))))
    return looked, blind


def with_resolution(settings: OrthoSettings, looked: Sequence[Looked], force: bool) -> OrthoSettings:
    """Settings with a resolution: the images' own if none is chosen."""
    own = two_figures(float(np.mean([one.look.gsd for one in looked]))) if looked else 1.0
    resolution = settings.resolution or own
    if looked and not force:
        _refuse_too_fine(resolution, settings, looked)
    return settings.replace(resolution=resolution)


def _refuse_faults(
    project: Project, seen: dict[str, tuple[JudgedView | None, ImagePlausibility]], scenes: dict[str, Scene]
) -> None:
    """Refuse what `check` calls a fault or read wrongly; images that see no terrain are told otherwise."""
    if not seen:
        return
    faults = [found for _, found in seen.values() if found.fault is not None]
    other = reading_of_block(project, seen, scenes[next(iter(seen))].ground)
    forced = "nothing is made of them unless you say `force`"
    if faults:
        raise GeometryError(
            f"image {faults[0].name!r}: {faults[0].fault} ({len(faults)} of {len(seen)} images have such faults, "
            f"`photoplan check` lists them); {forced}" + ("" if other is None else f". {other}")
        )
    if other is not None:
        raise GeometryError(f"another reading of the orientations fits better; {forced}. {other}")


def _refuse_feet(scenes: Sequence[Scene]) -> None:
    told = heights_in_feet(scenes[0].surface, [scene.camera for scene in scenes]) if scenes else None
    if told is not None:
        raise GeometryError(f"{told}; nothing is made of it unless you say `force`")


def heights_in_feet(surface: Terrain, cameras: Sequence[Camera]) -> str | None:
    """Return a sentence on objects above every camera that would stand on the ground in feet, or None."""
    highest = max(float(camera.vantage.point[2]) for camera in cameras)
    tall = as_if_in_feet(surface, highest)
    if not tall:
        return None
    name, top = next(iter(tall.items()))
    more = f" (and {len(tall) - 1} more)" if len(tall) > 1 else ""
    return (
        f"object {name!r}{more} rises to {top:.1f} m, above all cameras (the highest is at {highest:.1f} m), and would "
        "stand on the ground if its heights were in feet: convert them to metres"
    )


def _refuse_too_fine(resolution: float, settings: OrthoSettings, looked: Sequence[Looked]) -> None:
    """Refuse a resolution at which most pixels would be made up."""
    finest = min((one.look.gsd for one in looked if one.look.gsd > 0), default=0.0)
    if not resolution * _FINER < finest:
        return
    pixels = tiles = 0.0
    for name, bounds in ((one.name, settings.bounds or one.look.footprint.bounds) for one in looked):
        assert bounds is not None
        width, height = ((bounds[k + 2] - bounds[k]) / resolution for k in (0, 1))
        refuse_absurd((width, height), settings.tile, f"{name}: resolution {resolution:g} m")
        pixels += width * height
        tiles += math.ceil(width / settings.tile) * math.ceil(height / settings.tile)
    raise UsageError(
        f"resolution {resolution:g} m is {finest / resolution:.3g} times finer than the images see the ground "
        f"({finest:.3g} m): {pixels:.3g} pixels in {tiles:.3g} tiles, most of them made up; "
        f"choose {advised(finest / 2)} m or more, or say `force`"
    )


def two_figures(value: float) -> float:
    """A positive number rounded to two significant figures."""
    digits = 1 - math.floor(math.log10(value))
    return round(value, digits)


def _sees_no_terrain(scene: Scene, name: str) -> str:
    """Extents of both the terrain and what the image looks at, on a level that the terrain has."""
    vantage = scene.camera.vantage
    x, y, z = vantage.point
    center = f"{name}: projection centre {x:.0f} {y:.0f} {z:.0f}"
    if not vantage.central:
        center = f"{name}: near {x:.0f} {y:.0f}, known for heights from {vantage.floor:.0f} to {z:.0f},"
    bounds = scene.ground.bounds
    if bounds is None:
        return f"{center} sees nothing of the level terrain; is it above it, and do height systems and angles fit?"
    level = some_height(scene.ground.bare, bounds, x, y)
    if not (vantage.central or vantage.floor < level < z):
        level = (vantage.floor + z) / 2
    foot = on_level(scene.camera, image_border(scene.camera.size), level)[:, :2]
    if np.isfinite(foot).any():
        (xmin, ymin), (xmax, ymax) = np.nanmin(foot, axis=0), np.nanmax(foot, axis=0)
        looks = f"looks at {extent_text((xmin, ymin, xmax, ymax))} on the level {level:.0f}"
    else:
        looks = f"does not look down to the level {level:.0f}"
    return f"{center} {looks}; the terrain is {extent_text(bounds)}"


def _sees_no_target(scene: Scene, name: str) -> str:
    """Return where an image stands in the coordinates of a target that it does not see."""
    u, v, h = scene.camera.vantage.point
    behind = "; it stands behind the target" if not h > 0 else ""
    return (
        f"{name}: shows nothing of the target inside {extent_text(scene.ground.bounds)}, from {u:g} {v:g} {h:g}{behind}"
    )


def extent_text(bounds: tuple[float, float, float, float] | None) -> str:
    """Bounds as a message shows them: whole metres, or finer where they are narrower than 10 m."""
    if bounds is None:
        return "everywhere"
    sides = [side for side in (bounds[2] - bounds[0], bounds[3] - bounds[1]) if 1e-6 < side < 10.0]
    digits = max(0, math.ceil(1 - math.log10(min(sides, default=10.0))))
    return " ".join(f"{b:.{digits}f}" for b in bounds)


#: What it counts that a user prefers an image: more than any penalty of the score.
PREFERRED = 1000.0


@dataclass(frozen=True, eq=False)
class OrthoProduct:
    """One orthophoto, or a mosaic of many images, before its pixels."""

    plan: ProductPlan
    """Grid, table of sources, tiles and anchors' rule."""
    looks: tuple[Look, ...]
    """Views of its images, by row of the table of sources."""
    key: str
    """Hash of all that decides the pixels: inputs, orientation, settings, version."""
    part: SingleObject | None = None
    """Object that it shows, if it is the product of a single object."""

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images."""
        return self.plan.sources

    def address(self, project: Project) -> ScenesAddress:
        """Return the address by which its images and its ground are opened."""
        return ScenesAddress.of(project, self.images, self.part)

    @property
    def gsd(self) -> float:
        """Mean ground sampling distance of the images, metres."""
        return float(np.mean([look.gsd for look in self.looks]))

    @property
    def grid(self) -> MapGrid:
        """Map grid of the product."""
        assert isinstance(self.plan.target, MapTarget)
        return self.plan.target.grid


@dataclass(frozen=True, eq=False)
class OrthoPlan:
    """Orthophotos of a project, ready to be looked at, written and executed."""

    project: Project
    settings: OrthoSettings
    products: tuple[OrthoProduct, ...]
    blind: tuple[str, ...] = ()
    """A line for each image that was asked for and sees nothing of the terrain inside the bounds."""

    @property
    def of_objects(self) -> bool:
        """True if its products are those of single objects."""
        return any(product.part is not None for product in self.products)

    @property
    def command(self) -> Literal["ortho", "mosaic", "object"]:
        """The command that makes such products."""
        return "object" if self.of_objects else "ortho" if self.settings.choice is None else "mosaic"

    @property
    def what(self) -> str:
        """Its products, counted."""
        count, several = len(self.products), "" if len(self.products) == 1 else "s"
        if self.of_objects:
            return f"{count} product{several} of single objects"
        if self.settings.choice is not None:
            images = len({image for product in self.products for image in product.images})
            return f"mosaic of {counted(images, 'image')}" + (
                "" if self.settings.choice.sheets is None else f" in {count} sheets"
            )
        return f"{count} orthophoto{several}"

    def __getitem__(self, name: str) -> OrthoProduct:
        for product in self.products:
            if name == product.plan.name or product.images == (name,):
                return product
        raise KeyError(f"{name}; the plan has {', '.join(p.plan.name for p in self.products)}")

    def __str__(self) -> str:
        tiles = sum(len(p.plan.tiles) for p in self.products)
        lines = [f"{self.what}, {counted(tiles, 'tile')}, kernel {self.settings.kernel}{self.settings.filling}"]
        for p in self.products:
            images = "" if self.settings.choice is None else f"{counted(len(p.images), 'image')}, "
            lines.append(
                f"  {p.plan.name}: {images}{p.grid.width} × {p.grid.height} px of {p.grid.resolution:g} m, "
                f"{len(p.plan.tiles)} of {counted(p.plan.tiles.total, 'tile')}, GSD {p.gsd:.3g} m"
            )
        return "\n".join(lines)


def plan_orthophotos(
    project: Project,
    images: Sequence[str] | None = None,
    settings: OrthoSettings | None = None,
    *,
    events: Events = SILENT,
    force: bool = False,
    **changes: Any,
) -> OrthoPlan:
    """Plan an orthophoto for each image; no pixel is touched.

    Parameters
    ----------
    project : Project
    images : sequence of str, optional
        Names of images (patterns with ``*`` and ``?`` allowed); all images if it is None.
    settings : OrthoSettings, optional
        The project's own if it is None.
    events : Events
        Told of each image.
    force : bool
        Plan also what `photoplan check` calls a fault, and resolutions that are much finer than the images.
    **changes
        Single settings by name, for example ``resolution=0.1``.

    Raises
    ------
    InputError
        An input cannot be used.
    GeometryError
        No image sees the terrain (the extents of both are printed), or an orientation cannot be right.
    UsageError
        An unknown image or setting, bounds that hold nothing, or a resolution that is much too fine.
    """
    chosen = chosen_settings(project, settings, changes)
    project = _painted(project, chosen)
    names, stems = project.select(images), project.stems
    # Each image is looked at twice: where it lies, and which tiles it needs.
    events.begin("planning", 2 * len(names), "steps")
    looked, blind = look_at(project, names, force, events)
    events.done(len(names) - len(looked))
    chosen = with_resolution(chosen, looked, force)
    judge_bounds(project, chosen, [one.look.footprint for one in looked])
    products = []
    for one in looked:
        grid = grid_of(project, chosen, [one.look.footprint])
        check_storable(one.scene, one.name, grid, chosen)
        tiles = covered_tiles(one.scene.camera, painted_surface(one.scene.surface), grid, chosen.tile)
        if len(tiles):
            plan = product_plan(f"{stems[one.name]}_ortho", (one.name,), grid, tiles, chosen, [one.look])
            products.append(OrthoProduct(plan, (one.look,), keyed(project, plan, chosen)))
        else:
            seen = extent_text(one.look.footprint.bounds)
            blind.append(f"{one.name}: sees {seen}; the bounds are {extent_text(chosen.bounds)}")
        events.done()
    refuse_blind(chosen, products, blind)
    return OrthoPlan(project, chosen, tuple(products), tuple(blind))


def chosen_settings(project: Project, settings: OrthoSettings | None, changes: dict[str, Any]) -> OrthoSettings:
    """The project's settings or others, with single ones changed."""
    known = OrthoSettings.model_fields
    if unknown := sorted(set(changes) - set(known)):
        raise UsageError(f"unknown settings {', '.join(unknown)}; known are {', '.join(sorted(known))}")
    return OrthoSettings(**{**(dict(settings) if settings else project.ortho_settings()), **changes})


def _painted(project: Project, settings: OrthoSettings) -> Project:
    """The project with the objects that an orthophoto needs, as it needs them."""
    if settings.true or not project.objects:
        return project
    # An ordinary orthophoto shows the ground; objects only matter to it if somebody asks what they hide.
    hiding = tuple(each.model_copy(update={"role": "occluder"}) for each in project.objects)
    return project.model_copy(update={"objects": () if settings.hidden == "show" else hiding})


def grid_of(project: Project, settings: OrthoSettings, seen: Sequence[Footprint]) -> MapGrid:
    """Pixels of a product: all that its images see, or the bounds that were chosen."""
    assert settings.resolution is not None
    extents = np.array([one.bounds for one in seen if one.bounds is not None])
    low, high = extents[:, :2].min(axis=0).tolist(), extents[:, 2:].max(axis=0).tolist()
    return MapGrid.covering(settings.bounds or (*low, *high), settings.resolution, project.plane_crs)


def judge_bounds(project: Project, settings: OrthoSettings, seen: Sequence[Footprint]) -> None:
    """Refuse bounds that are in another order or CRS, by what the images see."""
    extents = np.array([one.bounds for one in seen if one.bounds is not None])
    if settings.bounds is None or not len(extents) or project.target is not None:
        return
    low, high = extents[:, :2].min(axis=0).tolist(), extents[:, 2:].max(axis=0).tolist()
    if (fault := bounds_fault(settings.bounds, project.crs, (*low, *high))) is not None:
        raise UsageError(fault)


def refuse_blind(settings: OrthoSettings, products: Sequence[Any], blind: Sequence[str]) -> None:
    """Refuse a plan without a product, or without an image."""
    if not products:
        where = "the terrain" if settings.bounds is None else "terrain inside the bounds"
        raise GeometryError(f"no image sees {where} (xmin ymin xmax ymax in metres):\n  " + "\n  ".join(blind))


def product_plan(
    name: str,
    images: tuple[str, ...],
    grid: MapGrid,
    tiles: Tiles,
    settings: OrthoSettings,
    looks: Sequence[Look],
    regions: Drawn | None = None,
) -> ProductPlan:
    """A product of one image or of many, from what each of them sees of the terrain."""
    rule = AnchorRule.of(settings.kernel, settings.tolerance)
    if settings.choice is None:
        owners = None if settings.hidden == "show" else InSight(paints_hidden=settings.hidden == "mark")
        return ProductPlan(
            name=name,
            sources=images,
            target=MapTarget(grid),
            rule=rule,
            tiles=tiles,
            owners=owners,
            fill_hidden=settings.fill_hidden,
        )
    best = _best(images, settings, settings.choice, looks, regions)
    choice = settings.choice
    feather = feather_of(choice.feather, grid.resolution, settings.tile, choice.blend == "multiband")
    if settings.fill_hidden and len(images) > MOST_IMAGES:
        raise UsageError(f"`fill_hidden` with {len(images):,} images in one product; at most {MOST_IMAGES:,} can be")
    return ProductPlan(
        name=name,
        sources=images,
        target=MapTarget(grid),
        rule=rule,
        tiles=tiles,
        owners=best,
        feather=feather,
        fill_hidden=settings.fill_hidden,
    )


def _best(
    images: tuple[str, ...], settings: OrthoSettings, choice: Choice, looks: Sequence[Look], regions: Drawn | None
) -> BestImage:
    """Return the rule by which one of many images paints a pixel."""
    ranges = np.array([look.footprint.height_range for look in looks])
    first, weights = choice.prefer, choice.weights
    ranks = [float(first.index(name) - len(first)) * PREFERRED if name in first else 0.0 for name in images]
    return BestImage(
        levels=(float(np.nanmin(ranges[:, 0])), float(np.nanmax(ranges[:, 1]))),
        weights=weights,
        ranks=tuple(rank + weights.sharpness * look.blur for rank, look in zip(ranks, looks)),
        drawn=regions,
        paints_hidden=settings.hidden != "nodata",
    )


def check_storable(scene: Scene, name: str, grid: MapGrid, settings: OrthoSettings) -> None:
    """Refuse a product that cannot be written, before any is."""
    refuse_absurd((grid.width, grid.height), settings.tile, f"{name}: resolution {settings.resolution:g} m")
    nodata_for(scene.reader.dtype, settings.nodata_value, settings.compress)
    if settings.compress == "jpeg" and (scene.reader.dtype != np.uint8 or scene.reader.bands not in (1, 3)):
        raise UsageError(
            f"{name}: {scene.reader.bands} bands of {scene.reader.dtype}; compression jpeg takes one or three of uint8"
        )


def painting(product: OrthoProduct, settings: OrthoSettings) -> Direct | None:
    """Return what paints the tiles of a product, if it is not the engine's resampling."""
    return None if settings.method == "indirect" else Direct(product.looks[0].footprint.height_range, settings.fill)


def render(
    plan: OrthoPlan, name: str, bounds: tuple[float, float, float, float] | None = None
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Execute a product, or a part of it, into memory.

    Parameters
    ----------
    plan : OrthoPlan
    name : str
        Name of the image or product.
    bounds : (float, float, float, float), optional
        xmin ymin xmax ymax of the part, snapped outwards to pixels; the whole product if it is None.

    Returns
    -------
    values : ndarray, shape (bands, height, width)
        0 where invalid.
    valid : ndarray of bool, shape (height, width)
    """
    product = plan[name]
    window = product.grid.window if bounds is None else product.grid.window_of(bounds)
    scenes = product.address(plan.project).open()
    tiles = (tile for tile in product.plan.tiles if (tile.window & window).size)
    paint = painting(product, plan.settings)

    def painted(tile: Tile) -> Painted:
        if paint is not None:
            return paint.render(product.plan, tile, scenes.sources, scenes.surface)
        made = render_tile(product.plan, tile, scenes.sources, scenes.surface, plan.settings.kernel)
        return with_holes_filled(product.plan, tile, scenes.sources, scenes.surface, plan.settings.kernel, made)

    parts = ((tile.window, painted(tile)) for tile in tiles)
    whole = joined(window, parts, scenes[0].reader)
    assert whole.values is not None and whole.valid is not None
    return whole.values, whole.valid
