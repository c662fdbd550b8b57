"""Check of a project: plausibility, resolution and sensitivity of its images, from a few windows of pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from photoplan.cameras.base import Camera, tremor_told, tremors_of
from photoplan.cameras.base import project as image_points
from photoplan.errors import GeometryError, InputError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.crs import crs_label
from photoplan.geometry.local import MEAN_RADIUS
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Image, Project, image_size
from photoplan.orientation.conventions import ImagePlausibility, JudgedView
from photoplan.plain import pick
from photoplan.plan.footprint import Footprint, footprint, mean_gsd
from photoplan.products.balance import colour_advice
from photoplan.products.orthophoto.plan import heights_in_feet, two_figures
from photoplan.products.plausibility import against_files, judged, reading_of_block
from photoplan.project.cameras import camera_without_pixels, is_there, posed_camera
from photoplan.project.ground import Ground, ground_of
from photoplan.project.scene import map_order, open_scene, refuse_unusable, unusable_images
from photoplan.requests.project import CheckRequest
from photoplan.surfaces.shifted import intersect

#: Displacements by the choice of earth curvature above this are reported, pixels.
_CHOICE_MATTERS = 0.1

#: Pixels that are so many times longer than wide on the ground are none of a scanner.
_LONGEST = 50.0
#: From here on it is told: speed, height above ground and line period fit each other in most flights.
_LONG = 2.5
#: Lines that lie by this part of the image beside the smooth course are none of a flight, and at least so many pixels.
_TORN, _TORN_PIXELS = 0.5, 100.0
#: Rays along a side of an image that tell how much of it shows terrain.
_RAYS = 10


@dataclass(frozen=True)
class ImageCheck:
    """One image's line."""

    image: str
    tilt_deg: float
    """Angle between optical axis and nadir, degrees."""
    gsd: float
    """Mean ground sampling distance, metres; NaN if it sees no terrain."""
    footprint: tuple[float, float]
    """Extent of the footprint in X and Y, metres; NaN if it sees no terrain."""
    on_terrain: float
    """Part of the image whose rays meet the terrain, by a lattice of them, 0 to 1."""
    relief_px: float
    """Largest displacement in the image by an error of 1 m in height, pixels (Behr 1989, section 6.1.2)."""
    admissible_height_error: float
    """Height error that displaces the most sensitive point by one pixel, metres (Behr 1989, fig. 6.4)."""
    choice_px: float
    """Largest displacement between `earth_curvature` none and strict, pixels; NaN: there is no choice."""
    curvature_px: float
    """Largest displacement by the earth's curvature if it were ignored, pixels (Ecker 1991, eq. 4.17)."""
    fault: str | None
    """Reason why the orientation cannot be right; None if the image is plausible."""
    notes: tuple[str, ...]
    """Remarks on the file."""


@dataclass(frozen=True)
class ProjectCheck(Result):
    """All images of a project."""

    images: tuple[ImageCheck, ...]
    sensible_resolution: float
    """Mean ground sampling distance of all images, to two figures, metres (Behr 1989, eq. 5.8)."""
    heights: tuple[str, str, str]
    """Height systems of terrain and orientation, and the one that is worked in."""
    crs: str
    alternative: str | None
    """The reading of the orientation that would fit, where the declared one does not; None otherwise."""
    angles: bool
    """True if any image with a fault is oriented by angles, which might be read in another way."""
    advice: tuple[str, ...]
    """Sentences that tell what would be better."""
    left_out: tuple[str, ...] = ()
    """Images without orientation, and why."""
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Images whose files cannot be used, and why."""
    file: str = "project"
    """Name of the project in messages."""

    @property
    def implausible(self) -> tuple[str, ...]:
        """Images with a fault, and what it is."""
        return tuple(f"{i.image}: {i.fault}" for i in self.images if i.fault is not None)

    @property
    def remedy(self) -> str:
        """Return what may help if images have faults."""
        if self.angles:
            return self.alternative or "no other reading of the angles fits; look at heights, axes and image names"
        return self.alternative or "look at heights, the CRS, and whether geometry and image belong together"

    def json_fields(self) -> dict[str, Any]:
        """Height systems by what has them."""
        systems = dict(zip(("terrain", "orientation", "working"), self.heights))
        own = pick(self, "images", "sensible_resolution", "crs", "alternative", "advice", "left_out", "unusable")
        return {**own, "height_systems": systems}

    def __str__(self) -> str:
        return "\n".join(self.summary())

    def summary(self) -> Sequence[str]:
        """Return height systems, a line for each image, and what would be better."""
        width = max(5, *(len(i.image) for i in self.images))
        lines = [
            f"{crs_label(self.crs)} · heights: terrain {self.heights[0]}, orientation {self.heights[1]}",
            f"{'image':<{width}}   tilt       GSD        footprint   on terrain   1 m height   admissible   curvature",
        ]
        for i in self.images:
            size = f"{i.footprint[0]:.0f} × {i.footprint[1]:.0f} m"
            figures = (
                f"{i.tilt_deg:4.1f}°  {i.gsd:#7.3g} m  {size:>15}       {i.on_terrain:5.0%}   "
                f"{i.relief_px:7.2f} px   {i.admissible_height_error:#8.3g} m   {i.curvature_px:6.2f} px"
            )
            lines.append(f"{i.image:<{width}}  {figures.replace('nan', '  –')}")
            lines += [f"{'':<{width}}  note: {note}" for note in i.notes]
            lines += [f"{'':<{width}}  FAULT: {i.fault}"] if i.fault else []
        known = np.isfinite(self.sensible_resolution)
        closing = [f"sensible resolution {self.sensible_resolution:g} m" if known else "no sensible resolution"]
        if not self.implausible and self.alternative is None:
            closing.append("all plausible")
        count = len(self.left_out) + len(self.unusable) + len(self.images)
        if self.left_out:
            closing.append(f"{len(self.left_out)} of {count} images are not oriented")
        if self.unusable:
            closing.append(f"{len(self.unusable)} of {count} images cannot be used")
        lines += [f"left out: {line}" for line in self.left_out]
        lines += [f"left out: {name}: {reason}" for name, reason in self.unusable.items()]
        return [*lines, " · ".join(closing), *self.advice]

    def raise_failures(self) -> None:
        """Raise if orientations are implausible, another reading fits better, or files cannot be used."""
        if self.implausible or self.alternative is not None:
            faults = f"{len(self.implausible)} of {len(self.images)} images are implausible"
            if not self.implausible:
                faults = "another reading of the orientation fits better"
            first = f": {self.implausible[0]}" if self.implausible else ""
            raise GeometryError(f"{self.file}: {faults}{first}\n{self.remedy}")
        refuse_unusable(self.unusable, len(self.images) + len(self.left_out) + len(self.unusable))


def check(request: CheckRequest, events: Events = SILENT) -> ProjectCheck:
    """Check a project file; see `check_project`."""
    found = check_project(load_project(request.project), request.images or None)
    return replace(found, file=str(request.project))


def check_project(project: Project, images: Sequence[str] | None = None) -> ProjectCheck:
    """Open every input of a project, and compute what its images promise; their files need not be there.

    Parameters
    ----------
    images : sequence of str, optional
        Names or patterns; all images if it is None.

    Raises
    ------
    PhotoplanError
        An input of all images, or every image, cannot be used. Single images are left out.
    """
    names, left_out = project.oriented(project.select(images))
    ground = ground_of(project)
    looked: dict[int, tuple[JudgedView | None, ImagePlausibility, ImageCheck]] = {}
    failed: dict[int, InputError] = {}
    for place in map_order(project, names):
        # All that is asked of the terrain for one image, before the next: its blocks are then at hand.
        try:
            view, found = judged(project, project.any_image(names[place]), ground)
            looked[place] = view, found, _check_image(project, ground, found)
        except InputError as error:
            failed[place] = error
    if not looked:
        raise next(iter(failed.values()))
    views, looks, good = zip(*(looked[place] for place in sorted(looked)))
    known = [names[place] for place in sorted(looked)]
    lost = unusable_images(project, [names[place] for place in failed], "")
    checks = tuple(
        looked[place][2] if place in looked else _refused(name, failed[place])
        for place, name in enumerate(names)
        if name not in lost
    )
    gsds = [c.gsd for c in checks if np.isfinite(c.gsd)]
    return ProjectCheck(
        images=checks,
        sensible_resolution=two_figures(float(np.mean(gsds))) if gsds else float("nan"),
        heights=(*ground.height_systems, ground.working_system),
        crs=project.crs,
        alternative=reading_of_block(project, dict(zip(known, zip(views, looks))), ground),
        angles=any(view is not None for view, check in zip(views, good) if check.fault),
        advice=_advice(project, good) + _of_objects(project, ground, known),
        left_out=tuple(left_out),
        unusable=lost,
    )


def _refused(name: str, error: InputError) -> ImageCheck:
    """Return the line of an image whose geometry or steps cannot be used."""
    nan = float("nan")
    return ImageCheck(
        image=name,
        tilt_deg=nan,
        gsd=nan,
        footprint=(nan, nan),
        on_terrain=nan,
        relief_px=nan,
        admissible_height_error=nan,
        choice_px=nan,
        curvature_px=nan,
        fault=f"cannot be used: {error}",
        notes=(),
    )


def _of_objects(project: Project, ground: Ground, names: Sequence[str]) -> tuple[str, ...]:
    """Return what cannot be right about the objects as a whole."""
    if not project.objects:
        return ()
    told = heights_in_feet(ground.surface, [camera_without_pixels(project, name) for name in names])
    return () if told is None else (told,)


def _check_image(project: Project, ground: Ground, looked: ImagePlausibility) -> ImageCheck:
    name, tilt, fault = looked.name, looked.tilt, looked.fault
    sees_objects = looked.level and looked.on_terrain == 0 and fault is None
    image = project.any_image(name)
    file = project.resolve(image.file)
    if is_there(file):
        scene = open_scene(project, name)
        camera, notes = scene.camera, scene.notes
    else:
        camera, notes = camera_without_pixels(project, name), (f"{file} is not there: all but its pixels is checked",)
    notes = (*image.remarks, *notes)
    # Figures are those of the ground, whether a product will show objects or not.
    seen = footprint(camera, ground.bare, ground.bounds)
    nan = float("nan")
    if seen.bounds is None:
        if sees_objects:
            notes = (*notes, "sees objects of the project, and nothing of the terrain")
        else:
            fault = fault or "sees nothing of the terrain" + (f" (tilt {tilt:.1f}°)" if np.isfinite(tilt) else "")
        return ImageCheck(
            image=name,
            tilt_deg=tilt,
            gsd=nan,
            footprint=(nan, nan),
            on_terrain=seen.on_surface,
            relief_px=nan,
            admissible_height_error=nan,
            choice_px=nan,
            curvature_px=nan,
            fault=fault,
            notes=notes,
        )
    shaken = tremor_told(camera, seen.usual_height)
    if shaken is not None:
        notes = (*notes, shaken)
        fault = fault or _torn(camera)
    relief, curvature = _sensitivity(camera, seen)
    longer = _longer(camera, seen)
    if longer > _LONGEST:
        fault = fault or f"its pixels are {longer:.0f} times longer than wide on the ground: is a scale wrong?"
    elif longer > _LONG:
        notes = (*notes, f"its pixels are {longer:.1f} times as long one way as the other on the ground")
    xmin, ymin, xmax, ymax = seen.bounds
    return ImageCheck(
        image=name,
        tilt_deg=tilt,
        gsd=mean_gsd(camera, seen),
        footprint=(xmax - xmin, ymax - ymin),
        on_terrain=_on_terrain(camera, ground, seen),
        relief_px=relief,
        admissible_height_error=1 / relief if relief > 0 else nan,
        choice_px=_choice(project, name, ground, seen),
        curvature_px=curvature,
        fault=fault,
        notes=notes,
    )


def _on_terrain(camera: Camera, ground: Ground, seen: Footprint) -> float:
    """Return the part of an image that shows terrain, by rays all over it: a model may have holes and an edge."""
    part = (np.arange(_RAYS) + 0.5) / _RAYS
    xy = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * camera.size - 0.5
    return float(np.isfinite(intersect(camera, xy, ground.bare, seen.height_range)[:, 0]).mean())


def _torn(camera: Camera) -> str | None:
    """Return a fault if lines lie farther from the smooth course than any aircraft flies: angles are read wrongly."""
    far = max(float(tremor.largest.max()) for tremor in tremors_of(camera))
    if far <= max(_TORN * max(camera.size), _TORN_PIXELS):
        return None
    return (
        f"its lines lie up to {far:.0f} pixels from the smooth course: are angles in another unit or order, or is κ a "
        "heading (0 to the north, clockwise)?"
    )


def _longer(camera: Camera, seen: Footprint) -> float:
    """Return the median ratio of length and width of pixels on the ground; 1 for central cameras."""
    points = seen.outline[np.isfinite(seen.outline).all(axis=1)]
    if camera.vantage.central or not len(points):
        return 1.0
    J = camera.derivatives(points)[..., :2]
    J = J[np.isfinite(J).all(axis=(1, 2))]
    wide = np.linalg.svd(J, compute_uv=False) if len(J) else np.ones((1, 2))
    return float(np.median(wide[:, 0] / np.maximum(wide[:, 1], 1e-300)))


def _sensitivity(camera: Camera, seen: Footprint) -> tuple[float, float]:
    """Return the largest displacements by 1 m of height and by the earth's curvature over the footprint, pixels."""
    outline = seen.outline
    points = outline[np.isfinite(outline).all(axis=1)]
    if not len(points):
        return float("nan"), float("nan")
    per_metre = np.linalg.norm(camera.derivatives(points)[..., 2], axis=-1)
    # Ecker 1991, eq. 4.17 with Z̄ = 0: the ground falls away from the tangential plane by d² / 2R.
    # Polynomials hold it.
    vantage = camera.vantage
    away = points[:, :2] - vantage.point[:2] if vantage.central else np.zeros((len(points), 2))
    drop = (away**2).sum(axis=1) / (2 * MEAN_RADIUS)
    return float(np.nanmax(per_metre)), float(np.nanmax(per_metre * drop))


def _choice(project: Project, name: str, ground: Ground, seen: Footprint) -> float:
    """Return the largest distance between image points by `earth_curvature` none and strict over the footprint, pixels.

    Heights are taken as they are: an undulation of 100 m changes the scale by 2e-5.
    """
    image = project.any_image(name)
    points = seen.outline[np.isfinite(seen.outline).all(axis=1)]
    if not isinstance(image, Image) or not len(points):
        return float("nan")
    stated = project.orientation.earth_curvature
    found = []
    for curvature in ("strict", stated if stated != "strict" else "none"):
        orientation = project.orientation.model_copy(update={"earth_curvature": curvature})
        size = image_size(project.cameras[image.camera], image)
        camera = posed_camera(project.model_copy(update={"orientation": orientation}), image, ground, size)
        found.append(image_points(camera, points))
    return float(np.nanmax(np.linalg.norm(found[0] - found[1], axis=1), initial=0.0))


def _advice(project: Project, checks: Sequence[ImageCheck]) -> tuple[str, ...]:
    lines = list(against_files(project, [check.image for check in checks]))
    choice = float(np.nanmax([c.choice_px for c in checks] + [0.0]))
    if choice > _CHOICE_MATTERS:
        stated = project.orientation.earth_curvature
        lines.append(
            f"earth_curvature {stated} in [orientation] displaces image points by up to {choice:.2g} px against "
            f"{'none' if stated == 'strict' else 'strict'} (map scale and curvature): none is right for orientations "
            "adjusted in map coordinates (PATB, BINGO, Inpho, Pix4D), strict for those computed in true metres "
            "(OpenSfM, ODM, Metashape)"
        )
    if not any(check.fault for check in checks) and (colours := colour_advice(project, [c.image for c in checks])):
        lines.append(colours)
    return tuple(lines)
