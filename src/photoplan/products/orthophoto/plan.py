"""Orthophotos: read a project, compile a plan, look at it, execute it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.direct import Direct
from photoplan.engine.execute import Painted, joined, with_holes_filled
from photoplan.engine.execute import render as render_tile
from photoplan.engine.holes import MOST_IMAGES
from photoplan.errors import GeometryError, UsageError
from photoplan.events import SILENT, Events
from photoplan.geometry.bounds import bounds_fault
from photoplan.geometry.grid import MapGrid, refuse_absurd
from photoplan.io.project.model import Project
from photoplan.io.storage import nodata_for
from photoplan.plan.choice import BestImage, Drawn
from photoplan.plan.compile import AnchorRule
from photoplan.plan.feather import feather_of
from photoplan.plan.footprint import Footprint, covered_tiles
from photoplan.plan.owner import InSight
from photoplan.plan.product import ProductPlan
from photoplan.plan.tiles import Tile, Tiles
from photoplan.products.orthophoto.keys import keyed
from photoplan.products.orthophoto.look import Look, extent_text, look_at, with_resolution
from photoplan.products.orthophoto.settings import Choice, OrthoSettings
from photoplan.project.scene import Scene
from photoplan.project.scenes import ScenesAddress
from photoplan.surfaces.objects import SingleObject, painted_surface
from photoplan.targets.map import MapTarget

#: What it counts that a user prefers an image: more than any penalty of the score.
PREFERRED = 1000.0


@dataclass(frozen=True, eq=False)
class OrthoProduct:
    """One orthophoto, or a mosaic of many images, before its pixels."""

    plan: ProductPlan
    """Grid, table of sources, tiles and anchors' rule."""
    looks: tuple[Look, ...]
    """What each of its images sees, by row of the table of sources."""
    key: str
    """Hash of all that decides the pixels: inputs, orientation, settings, version."""
    part: SingleObject | None = None
    """What it shows, where it is the product of a single object."""

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the images."""
        return self.plan.sources

    def address(self, project: Project) -> ScenesAddress:
        """What its images and its ground are opened by."""
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
        """Whether its products are those of single objects."""
        return any(product.part is not None for product in self.products)

    @property
    def command(self) -> Literal["ortho", "mosaic", "object"]:
        """The command that makes such products."""
        return "object" if self.of_objects else "ortho" if self.settings.choice is None else "mosaic"

    @property
    def what(self) -> str:
        """What it makes, counted."""
        count, several = len(self.products), "" if len(self.products) == 1 else "s"
        if self.of_objects:
            return f"{count} product{several} of single objects"
        if self.settings.choice is not None:
            images = len({image for product in self.products for image in product.images})
            return f"mosaic of {images} images" + ("" if self.settings.choice.sheets is None else f" in {count} sheets")
        return f"{count} orthophoto{several}"

    def __getitem__(self, name: str) -> OrthoProduct:
        for product in self.products:
            if name == product.plan.name or product.images == (name,):
                return product
        raise KeyError(f"{name}; the plan has {', '.join(p.plan.name for p in self.products)}")

    def __str__(self) -> str:
        tiles = sum(len(p.plan.tiles) for p in self.products)
        lines = [f"{self.what}, {tiles} tiles, kernel {self.settings.kernel}{self.settings.filling}"]
        for p in self.products:
            images = "" if self.settings.choice is None else f"{len(p.images)} images, "
            lines.append(
                f"  {p.plan.name}: {images}{p.grid.width} × {p.grid.height} px of {p.grid.resolution:g} m, "
                f"{len(p.plan.tiles)} of {p.plan.tiles.total} tiles, GSD {p.gsd:.3g} m"
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
    return OrthoSettings.from_dict({**(asdict(settings) if settings else project.ortho_settings()), **changes})


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
    return MapGrid.covering(settings.bounds or (*low, *high), settings.resolution, project.crs)


def judge_bounds(project: Project, settings: OrthoSettings, seen: Sequence[Footprint]) -> None:
    """Refuse bounds that are in another order or CRS, by what the images see."""
    extents = np.array([one.bounds for one in seen if one.bounds is not None])
    if settings.bounds is None or not len(extents):
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
    """Who of many images paints a pixel."""
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
    """What paints the tiles of a product, where it is not the engine's resampling."""
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
