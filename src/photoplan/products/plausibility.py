"""Plausibility of orientations, and images of one colour."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.engine.execute import Reader
from photoplan.errors import InputError
from photoplan.geometry.bounds import area_note
from photoplan.geometry.crs import agreement, crs_step
from photoplan.geometry.grid import Window
from photoplan.io.image_metadata import IMAGE_SUFFIXES, read_image_metadata
from photoplan.io.orientation.block import OrientationTable
from photoplan.io.project.model import Image, ImageEntry, Project
from photoplan.orientation.conventions import ImagePlausibility, JudgedView, better_convention, look
from photoplan.plan.footprint import footprint, mean_gsd
from photoplan.project.cameras import camera_without_pixels, is_there, pose_of, view_of
from photoplan.project.ground import Ground
from photoplan.surfaces.objects import ObjectSurface

#: Sides of the window that is looked at first, which tells of nearly every image that it has more than one grey value,
#: and of those that follow, pixels.
_FIRST, _NEXT = 64, 1024


def one_colour_told(name: str, grey: float) -> str:
    """That an image has one grey value, and what to do."""
    return f"{name!r} has the grey value {grey:.0f} everywhere; look at its file, or take the image out of the project"


def one_colour(reader: Reader) -> float | None:
    """The grey value that all valid pixels of an image have in all bands; None: they differ, or none is valid."""
    width, height = reader.size
    whole, found = Window(0, 0, width, height), None
    # At the upper border: large pictures that are decoded from there on are not decoded as a whole for it.
    first = Window(max(0, (width - _FIRST) // 2), 0, _FIRST, _FIRST) & whole
    for window in chain([first], whole.tiles(_NEXT)):
        pixels, valid = reader.read(window)
        values = pixels if valid is None else pixels[:, valid]
        if not values.size:
            continue
        low, high = float(values.min()), float(values.max())
        if low != high or found not in (None, low):
            return None
        found = low
    return found


_Floats = NDArray[np.float64]

#: No receiver is off by so much, metres.
_FAR = 1000.0
#: A turn of the block against its positions that is told: degrees, and in its own standard deviations.
_TURN, _CLEAR = 0.2, 6.0
#: A shift that all images share and that is told: metres, and in the scatter of single positions.
_SHIFT, _ALIKE = 50.0, 10.0
#: Images needed before their common way is judged.
_ENOUGH = 4
#: Images that are looked at for the reading of a block, if fewer are asked for.
_NEIGHBOURS = 40


def judged(project: Project, image: ImageEntry, ground: Ground) -> tuple[JudgedView | None, ImagePlausibility]:
    """An oriented image, and what follows from its orientation: by its CRS, its file's own position, and the terrain.

    Without a pose there is nothing that could be read in another way, and so no view.

    Objects do not count: a camera below a bridge is not below the ground.
    """
    if not isinstance(image, Image):
        return None, _without_pose(project, image.name, ground)
    center = pose_of(project, image, ground).center
    view = view_of(image, project.cameras[image.camera], project.orientation, center)
    found = look(view, ground.bare.heights, _object_triangles(ground))
    odd = project.area_fault(center) or position_fault(project, image)
    return view, found if odd is None else replace(found, fault=odd)


def _object_triangles(ground: Ground) -> _Floats | None:
    """Return the triangles (n, 3, 3) of the project's objects; None if it has none."""
    return ground.surface.faces.corners if isinstance(ground.surface, ObjectSurface) else None


def _without_pose(project: Project, name: str, ground: Ground) -> ImagePlausibility:
    """Return the result for an image whose rays meet nowhere."""
    camera = camera_without_pixels(project, name)
    place = camera.vantage.point
    seen = footprint(camera, ground.bare, ground.bounds)
    nan = float("nan")
    found = ImagePlausibility(
        name=name,
        tilt=nan,
        azimuth=nan,
        height_above_ground=nan,
        gsd=nan,
        on_terrain=seen.on_surface,
        middle_on_terrain=seen.on_surface > 0,
        fault=project.area_fault(place),
    )
    if seen.bounds is None:
        return found
    middle = (np.array(camera.size) - 1) / 2
    d = camera.rays(middle, float(np.clip(np.mean(seen.height_range), camera.vantage.floor, place[2])))[1]
    tilt, azimuth = np.degrees([np.arccos(-d[2]), np.arctan2(d[0], d[1])])
    return replace(found, tilt=float(tilt), azimuth=float(azimuth) % 360, gsd=mean_gsd(camera, seen))


def reading_of_block(
    project: Project, seen: Mapping[str, tuple[JudgedView | None, ImagePlausibility]], ground: Ground
) -> str | None:
    """The reading of the orientation that would fit better than the declared one, see `better_convention`.

    Few images say little of tilts and flight lines: the other images of the block beside them are looked at, too.
    """
    looked = {name: (view, found) for name, (view, found) in seen.items() if view is not None}
    if not looked:
        return None
    first = next((view.center for view, _ in looked.values()), None)
    others = [image for image in project.posed if image.center is not None and image.name not in looked]
    if first is not None and len(looked) < _NEIGHBOURS:
        others.sort(key=lambda image: float(np.hypot(*(np.array(image.center)[:2] - first[:2]))))
        for image in others[: _NEIGHBOURS - len(looked)]:
            view = view_of(
                image, project.cameras[image.camera], project.orientation, pose_of(project, image, ground).center
            )
            looked[image.name] = view, look(view, ground.bare.heights, _object_triangles(ground))
    views, looks = [view for view, _ in looked.values()], [found for _, found in looked.values()]
    return better_convention(views, looks, ground.bare.heights)


def geodetic_positions(files: Iterable[Path | None]) -> _Floats:
    """Latitude, longitude (degrees, WGS 84) and height that image files state, (n, 3); NaN where one does not."""
    return np.array([_position(file) for file in files], float).reshape(-1, 3)


def _position(file: Path | None) -> tuple[float, float, float]:
    nothing = (float("nan"),) * 3
    if file is None or file.suffix.lower() not in IMAGE_SUFFIXES or not is_there(file):
        return nothing
    try:
        stated = read_image_metadata(file)
    except InputError:
        return nothing
    wgs84 = (stated.datum or "WGS84").upper().replace("-", "").replace(" ", "").startswith("WGS84")
    return stated.position if stated.position is not None and wgs84 else nothing


def stated_positions(table: OrientationTable, files: Mapping[str, Path]) -> _Floats:
    """Latitude, longitude and height (n, 3) of a table's images: as it states them itself, else as their files do."""
    own = table.positions if table.positions is not None else np.full((len(table.images), 3), np.nan)
    known = np.isfinite(own[:, 0]) & np.isfinite(own[:, 1])
    read = geodetic_positions(None if known[k] else files.get(image.name) for k, image in enumerate(table.images))
    return np.where(known[:, None], own, read)


def on_map(geodetic: _Floats, crs: str) -> _Floats:
    """Map coordinates (n, 2) of latitudes and longitudes; NaN where there are none, or where the CRS has no place."""
    out = np.full((len(geodetic), 2), np.nan)
    for k in np.flatnonzero(np.isfinite(geodetic[:, :2]).all(axis=1)):
        try:
            out[k] = crs_step("EPSG:4326", crs)(geodetic[k, [1, 0]])
        except InputError:
            # One position outside the area of the CRS says nothing of the others.
            continue
    return out


def position_fault(project: Project, image: Image) -> str | None:
    """Return why an orientation cannot be that of the image file; None if it can, or the file states no position."""
    if image.center is None:
        return None
    stated = on_map(geodetic_positions([project.resolve(image.file)]), project.crs)
    away = float(np.hypot(*(stated[0] - image.center[:2])))
    if not away > _FAR:
        return None
    return f"its file states a GPS position {away / 1000:.3g} km away; is the CRS right, and the image the one meant?"


def against_files(project: Project, names: Sequence[str]) -> tuple[str, ...]:
    """Sentences on how the oriented images of a project lie to the positions of their files, those far off left out."""
    images = [image for image in project.posed if image.name in names and image.center is not None]
    stated = on_map(geodetic_positions(project.resolve(image.file) for image in images), project.crs)
    centers = np.array([image.center for image in images], float).reshape(-1, 3)
    outside = None if project.area_fault(centers) else area_note(project.crs, centers, [i.name for i in images])
    return (*([outside] if outside else []), *common_differences(centers, stated))


def differences(names: Sequence[str], centers: ArrayLike, stated: ArrayLike) -> tuple[str, ...]:
    """Sentences on what of projection centres and positions, both (n, 2) or more columns, cannot be right together."""
    away = np.hypot(*(np.asarray(stated, float)[:, :2] - np.asarray(centers, float)[:, :2]).T)
    far = np.flatnonzero(away > _FAR)
    if not len(far):
        return common_differences(centers, stated)
    worst = int(far[np.argmax(away[far])])
    return (
        f"{len(far)} of {int(np.isfinite(away).sum())} projection centres lie more than {_FAR / 1000:g} km from the "
        f"GPS positions that their files state (image {names[worst]!r} {away[worst] / 1000:.3g} km); is the CRS right, "
        "and are the images the ones meant?",
    )


def common_differences(centers: ArrayLike, stated: ArrayLike) -> tuple[str, ...]:
    """A sentence where a block is turned against its positions, or shifted as a whole."""
    found = agreement(stated, centers)
    if found.count < _ENOUGH:
        return ()
    turn, sigma = np.degrees([found.turn, found.sigma_turn])
    said = []
    if abs(turn) > max(_TURN, _CLEAR * sigma):
        said.append(
            f"the projection centres are turned by {turn:.2f}° ± {sigma:.2f}° against the GPS positions of "
            f"{found.count} image files: grid north, or the axes of another CRS?"
        )
    if _FAR > found.shift > max(_SHIFT, _ALIKE * found.scatter):
        said.append(
            f"the projection centres lie {found.shift:.0f} m from the GPS positions of {found.count} image files, all "
            f"alike to {found.scatter:.1f} m: another datum, or another zone?"
        )
    return tuple(said)
