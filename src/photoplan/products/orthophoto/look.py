"""What images see of the terrain, and what is refused before a product of them is planned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photoplan.cameras.base import Camera, on_level
from photoplan.errors import GeometryError, UsageError
from photoplan.events import Events
from photoplan.geometry.grid import refuse_absurd
from photoplan.io.project.model import Project
from photoplan.orientation.plausibility import ImagePlausibility, JudgedView
from photoplan.plain import advised
from photoplan.plan.footprint import Footprint, image_border, mean_gsd, some_height
from photoplan.products.judged import judged, reading_of_block
from photoplan.products.orthophoto.settings import OrthoSettings
from photoplan.project.scene import Scene, map_order, open_scene
from photoplan.surfaces.base import Terrain
from photoplan.surfaces.objects import as_if_in_feet

#: A product is at most so many times finer than its images see the ground.
_FINER = 4.0


@dataclass(frozen=True, eq=False)
class Look:
    """What an image sees of the terrain."""

    footprint: Footprint
    """Where it lies."""
    gsd: float
    """Its mean ground sampling distance, metres."""
    blur: float = 0.0
    """By how many powers of two its fine detail, beside the coarser, is weaker than that of the sharpest image of the
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
        if scene.footprint.bounds is not None:
            seen[names[place]] = judged(project, project.any_image(names[place]), scene.ground)
        events.done()
    if not force:
        _refuse_faults(project, seen, scenes)
        _refuse_feet(list(scenes.values()))
    looked = []
    for name, scene in ((name, scenes[name]) for name in names):
        if scene.footprint.bounds is None:
            blind.append(_sees_no_terrain(scene, name))
        else:
            looked.append(Looked(name, scene, Look(scene.footprint, mean_gsd(scene.camera, scene.footprint))))
    return looked, blind


def with_resolution(settings: OrthoSettings, looked: Sequence[Looked], force: bool) -> OrthoSettings:
    """Settings with a resolution: the images' own if none is chosen."""
    own = two_figures(float(np.mean([one.look.gsd for one in looked]))) if looked else 1.0
    resolution = settings.resolution or own
    if looked and not force:
        _refuse_too_fine(resolution, settings, looked)
    return replace(settings, resolution=resolution)


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
    """What to say of objects that rise above every camera, but would stand on the ground in feet; None: none does."""
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


def extent_text(bounds: tuple[float, float, float, float] | None) -> str:
    """Bounds as a message shows them: whole metres, or finer where they are narrower than 10 m."""
    if bounds is None:
        return "everywhere"
    sides = [side for side in (bounds[2] - bounds[0], bounds[3] - bounds[1]) if 1e-6 < side < 10.0]
    digits = max(0, math.ceil(1 - math.log10(min(sides, default=10.0))))
    return " ".join(f"{b:.{digits}f}" for b in bounds)
