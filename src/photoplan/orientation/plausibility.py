"""Do orientation, terrain and camera fit together, and if not: which reading of the angles would?

Only geometry is looked at: where an image looks, whether that is on the terrain, and how its axes lie to the flight
lines. A wrong rotation order that only turns a small tilt into another direction cannot be seen this way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.bounds import HIGHEST_FLIGHT
from photoplan.geometry.rotation import ANGLE_UNITS, rotation_from_angles
from photoplan.orientation.other_readings import DECLARED, OtherReading, readings

Heights = Callable[[NDArray[np.float64]], NDArray[np.float64]]

#: Images that are looked at under other readings.
SAMPLE = 12
#: A reading is taken as better by its tilts only if all stay below this, and half of the declared ones are above the
#: second; degrees. Between them lies everything that oblique images may be.
UPRIGHT, OBLIQUE = 10.0, 20.0
#: Images whose lines are looked at.
LINES = 400
#: Side of the area in which heights are asked for at once, metres.
CELL = 1000.0
#: Points that count as the image's middle.
INNER = 10
#: Images needed before tilts or flight lines say anything.
ENOUGH = 3
#: Slopes below the horizon (sines) from which a ray, and the middle of an image, may be expected to meet terrain.
DOWNWARD, MIDDLE_DOWNWARD = 0.01, 0.1


@dataclass(frozen=True, eq=False)
class JudgedView:
    """What the check needs to know of an image."""

    name: str
    center: NDArray[np.float64]
    """Projection centre (3,) in the terrain's CRS and height system."""
    angles: NDArray[np.float64]
    """Three angles (3,) in radians, in the sequence of `order`."""
    order: str
    """Rotation order that is declared."""
    tangents: NDArray[np.float64]
    """Ideal directions (n, 2) of points spread over the image, x right, y up; the first is the image's middle."""
    pixel: float
    """Angle of a pixel in the middle, radians."""
    unit: str = "deg"
    """Unit of the angles in the project."""
    mirrored: bool = False
    """Whether the camera is stated to be scanned through the back of its film."""

    @property
    def R_ground_camera(self) -> NDArray[np.float64]:
        """Rotation matrix as declared."""
        return rotation_from_angles(self.angles, self.order)


@dataclass(frozen=True)
class ImagePlausibility:
    """What follows from the orientation of one image."""

    name: str
    tilt: float
    """Angle between optical axis and nadir, degrees."""
    azimuth: float
    """Direction in which the axis is tilted, degrees from north, clockwise."""
    height_above_ground: float
    """Height of the projection centre above the terrain below it, metres; NaN where there is none."""
    gsd: float
    """Side of the middle pixel across the line of sight on the ground, metres; NaN if it sees no ground."""
    on_terrain: float
    """Share of the image that sees the terrain."""
    middle_on_terrain: bool
    """Whether the middle of the image does; for a level photograph, whether any part shows terrain or an object."""
    fault: str | None
    """What cannot be right; None if the image is plausible."""
    level: bool = False
    """Whether the image shows the horizon, and its middle lies near or above it: much of it cannot show terrain."""


def look(view: JudgedView, heights: Heights, objects: NDArray[np.float64] | None = None) -> ImagePlausibility:
    """Look at one image as its orientation is declared; `objects` (n, 3, 3) are triangles that it may show."""
    found = _look(view, view.center, view.R_ground_camera, heights)
    if found.level and found.on_terrain == 0 and objects is not None and _shows(view, objects):
        return replace(found, fault=None, middle_on_terrain=True)
    return found


def _shows(view: JudgedView, triangles: NDArray[np.float64]) -> bool:
    """Return whether the ray of any of the view's points meets one of the triangles (n, 3, 3)."""
    a, b, c = np.moveaxis((triangles - view.center) @ view.R_ground_camera, 1, 0)
    # A ray lies inside the three planes through the camera and the sides of a triangle.
    sides = np.stack([np.cross(a, b), np.cross(b, c), np.cross(c, a)])
    for t in view.tangents:
        ray = np.array([*t, -1.0])
        inside = np.sign(sides @ ray)
        volume = np.sign(np.einsum("ij,ij->i", a, sides[1]))
        if ((inside == volume).all(axis=0) & (volume != 0)).any():
            return True
    return False


def _look(view: JudgedView, center: NDArray[np.float64], R: NDArray[np.float64], heights: Heights) -> ImagePlausibility:
    axis = -R[:, 2]
    tilt = float(np.degrees(np.arccos(np.clip(-axis[2], -1, 1))))
    azimuth = float(np.degrees(np.arctan2(axis[0], axis[1])) % 360) if tilt > 1e-9 else 0.0
    below = float(heights(center[None, :2])[0])
    points = _footprint(center, R, view.tangents, below, heights)
    seen = np.isfinite(points[:, 2])
    d = np.column_stack([view.tangents, -np.ones(len(view.tangents))]) @ R.T
    slope = -d[:, 2] / np.linalg.norm(d, axis=1)
    downward = slope > DOWNWARD
    level = bool(slope[0] < MIDDLE_DOWNWARD and not downward.all())
    inner = np.argsort(np.linalg.norm(view.tangents - view.tangents[0], axis=1))[:INNER]
    # A hole in the terrain under the very middle is not a sign of anything, nor is sky in a level photograph.
    middle = bool(seen[0] or seen[inner].mean() > 0.5 or (level and seen.any()))
    distance = float(np.linalg.norm(points[inner[seen[inner]][0]] - center)) if seen[inner].any() else np.nan
    fault = None
    if center[2] <= below:
        fault = f"projection centre {below - center[2]:.1f} m below the terrain; are the height systems the same?"
    elif center[2] - below > HIGHEST_FLIGHT:
        fault = f"projection centre {center[2] - below:.3g} m above the terrain; are heights in millimetres?"
    elif not seen.any():
        above = "looks above the horizon and " if level and not downward.any() else ""
        fault = f"{above}sees nothing of the terrain (tilt {tilt:.1f}°)"
    return ImagePlausibility(
        name=view.name,
        tilt=tilt,
        azimuth=azimuth,
        height_above_ground=float(center[2] - below),
        gsd=distance * view.pixel,
        on_terrain=float(seen[downward].mean()) if downward.any() else 0.0,
        middle_on_terrain=middle,
        fault=fault,
        level=level,
    )


def _footprint(
    center: NDArray[np.float64], R: NDArray[np.float64], tangents: NDArray[np.float64], below: float, heights: Heights
) -> NDArray[np.float64]:
    """Terrain points (n, 3) that the tangents see, to some metres; NaN where they see none."""
    d = np.column_stack([tangents, -np.ones(len(tangents))]) @ R.T
    d[~(d[:, 2] < 0)] = np.nan
    level = np.full(len(d), below)
    points = np.full((len(d), 3), np.nan)
    if not np.isfinite(below):
        # The camera does not stand over the terrain: begin with heights that the rays come by.
        level[:] = _level_near(center, d, heights)
    for _ in range(5):
        with np.errstate(invalid="ignore"):
            points = center + d * ((level - center[2]) / d[:, 2])[:, None]
        there = np.isfinite(points[:, 0])
        found = np.full(len(d), np.nan)
        if there.any():
            found[there] = _ground(heights, points[there, :2])
        # A ray that has left the terrain stays on its last level, it may come back in the next step.
        level = np.where(np.isfinite(found), found, level)
    points[:, 2] = found
    return points


def _ground(heights: Heights, XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights at points that may lie far apart: asked for cell by cell, so that no large window is ever read."""
    out = np.full(len(XY), np.nan)
    cells, of = np.unique(np.floor(XY / CELL), axis=0, return_inverse=True)
    for k in range(len(cells)):
        mine = of.reshape(-1) == k
        out[mine] = heights(XY[mine])
    return out


def _level_near(center: NDArray[np.float64], d: NDArray[np.float64], heights: Heights) -> float:
    """A terrain height under the rays, for a camera that does not stand over the terrain; NaN if there is none."""
    flat = d[np.isfinite(d[:, 2])]
    if not len(flat):
        return np.nan
    reach = np.geomspace(10.0, 30_000.0, 20)
    rays = flat[:: max(1, len(flat) // 5)]
    points = center[:2] + reach[:, None, None] * (rays[:, :2] / np.abs(rays[:, 2:]))
    found = _ground(heights, points.reshape(-1, 2))
    good = np.isfinite(found)
    return float(np.median(found[good])) if good.any() else np.nan


def other_reading(views: Sequence[JudgedView], images: Sequence[ImagePlausibility], heights: Heights) -> str | None:
    """Sentence on the reading that fits where the declared one does not."""
    views, images = list(views), tuple(images)
    chosen = _sample(views, images)
    sample, declared = [views[k] for k in chosen], [images[k] for k in chosen]
    evidence = _Evidence.of(views, declared, DECLARED)
    if not evidence.doubtful:
        return None
    beside = sum(not image.middle_on_terrain for image in declared)
    ranked: list[tuple[tuple[float, ...], OtherReading, list[ImagePlausibility]]] = []
    for reading in readings(sample[0].order, sample[0].unit):
        # What one change explains needs no second, except where only the second makes the images upright.
        if ranked and reading.changes > ranked[0][1].changes and (ranked[0][0][0] < 0 or len(sample) < ENOUGH):
            break
        if not _possible(reading, evidence.largest):
            continue
        seen = _seen(sample, reading, heights, beside)
        if seen is None:
            continue
        other = _Evidence.of(views, seen, reading)
        if other.better_than(evidence, reading):
            upright = -float(other.steepest < UPRIGHT)
            rank = (upright, reading.changes, -round(other.on_terrain, 2), -round(other.alike, 2))
            ranked.append((rank, reading, seen))
            ranked.sort(key=lambda r: r[0])
    if not ranked:
        return None
    mirrored = any(view.mirrored for view in sample)
    equal = list(dict.fromkeys(r.sentence(mirrored) for rank, r, _ in ranked if rank == ranked[0][0]))
    lines = _alignment(views, DECLARED), _alignment(views, ranked[0][1])
    return _sentence(" — or: ".join(equal[:3]), (declared, ranked[0][2]), lines)


def _seen(
    views: list[JudgedView], reading: OtherReading, heights: Heights, most: int
) -> list[ImagePlausibility] | None:
    """What images show by a reading; None as soon as `_Evidence.better_than` is out of reach.

    That is where one has a fault, or more than `most` of them look beside the terrain.
    """
    seen: list[ImagePlausibility] = []
    for view in views:
        seen.append(_look(view, *reading.apply(view.center, view.angles, view.order), heights))
        if seen[-1].fault is not None or sum(not image.middle_on_terrain for image in seen) > most:
            return None
    return seen


@dataclass(frozen=True)
class _Evidence:
    """What a reading makes of a sample of images."""

    faults: int
    middles: float
    """Share of images whose middle is on the terrain."""
    on_terrain: float
    median_tilt: float
    steepest: float
    alike: float
    """How alike the image axes lie to the flight lines in all images, 0 to 1."""
    offset: float
    """Mean angle between image axes and flight lines, degrees, modulo 90."""
    largest: float
    """Largest declared angle, parts of a full circle."""
    count: int
    level: float
    """Share of level photographs, whose axes need not follow flight lines."""

    @classmethod
    def of(cls, views: list[JudgedView], images: list[ImagePlausibility], reading: OtherReading) -> _Evidence:
        tilts = [i.tilt for i in images]
        alike, offset = _alignment(views, reading)
        return cls(
            faults=sum(i.fault is not None for i in images),
            middles=float(np.mean([i.middle_on_terrain for i in images])),
            on_terrain=float(np.mean([i.on_terrain for i in images])),
            median_tilt=float(np.median(tilts)),
            steepest=max(tilts),
            alike=alike,
            offset=offset,
            largest=float(max(np.abs(v.angles).max() for v in views) / (2 * np.pi)),
            count=len(views),
            level=float(np.mean([i.level for i in images])),
        )

    @property
    def tilted(self) -> bool:
        return self.count >= ENOUGH and self.median_tilt > OBLIQUE

    @property
    def astray(self) -> bool:
        """Image axes lie in no relation to the flight lines, in a block where that means something."""
        return self.count >= 2 * ENOUGH and self.level < 0.5 and (self.alike < 0.85 or abs(self.offset) > 15)

    @property
    def doubtful(self) -> bool:
        return bool(self.faults) or self.middles < 0.8 or self.tilted or self.astray

    def better_than(self, declared: _Evidence, reading: OtherReading) -> bool:
        """Whether this reading removes what is wrong with the declared one; what only looks different is not better."""
        if self.faults or self.middles < declared.middles:
            return False
        # The terrain may end inside the block, so it is the gain that counts, not a share.
        if self.on_terrain > declared.on_terrain + 0.2 and (declared.faults or self.middles > declared.middles + 0.2):
            return True
        if declared.tilted and self.steepest < UPRIGHT:
            return True
        if not declared.astray or self.count < 2 * ENOUGH:
            return False
        if declared.alike < 0.85:
            return self.alike > 0.97 and abs(self.offset) < 5
        # All images lie alike, but askew. Only readings that people really mix up count then, since a heading that was
        # kept askew to the lines on purpose looks the same.
        usual = reading.changes == 1 and (reading.unit == "rad" or reading.transposed)
        return usual and self.alike > 0.9 and abs(self.offset) < 8


def _possible(reading: OtherReading, largest: float) -> bool:
    """Whether the largest declared angle, in parts of a full circle, can be what the reading takes it for."""
    if reading.unit == "rad":
        return largest * ANGLE_UNITS[reading.declared] < ANGLE_UNITS["rad"]
    if reading.unit is None or reading.declared != "rad":
        return True
    # Angles divided by 57 are upright whatever they were: only more than a full circle lets one think of that, and only
    # more than 360 of gon.
    return largest > 1.0 and (reading.unit == "gon") == (largest * ANGLE_UNITS["rad"] > ANGLE_UNITS["deg"])


def _sample(views: list[JudgedView], images: tuple[ImagePlausibility, ...]) -> list[int]:
    """Images for other readings: faulty ones first, then spread over the block."""
    faulty = [k for k, i in enumerate(images) if i.fault is not None or not i.middle_on_terrain]
    spread = [int(k) for k in np.linspace(0, len(views) - 1, min(SAMPLE, len(views)))]
    return list(dict.fromkeys(faulty[: SAMPLE // 2] + spread))[:SAMPLE]


def _alignment(views: list[JudgedView], reading: OtherReading) -> tuple[float, float]:
    """How the image axes lie to the flight lines: how alike in all images (0 to 1), and the mean difference (degrees).

    The line through an image and its nearest neighbour is along or across a strip, so angles count modulo 90°.
    """
    posed = [reading.apply(v.center, v.angles, v.order) for v in views[:LINES]]
    XY = np.array([center[:2] for center, _ in posed])
    if len(XY) < 2:
        return 1.0, 0.0
    apart = np.linalg.norm(XY[:, None] - XY, axis=2)
    np.fill_diagonal(apart, np.inf)
    to = XY[apart.argmin(axis=1)] - XY
    line = np.arctan2(to[:, 1], to[:, 0])
    kappa = np.array([np.arctan2(R[1, 0], R[0, 0]) for _, R in posed])
    mean = np.mean(np.exp(4j * (kappa - line)))
    return float(np.abs(mean)), float(np.degrees(np.angle(mean)) / 4)


def _sentence(
    what: str, seen: tuple[list[ImagePlausibility], list[ImagePlausibility]], lines: tuple[tuple[float, float], ...]
) -> str:
    """What would have to be declared, and what is better then: tilts, middles on the terrain, axes and flight lines."""

    def tilts(images: list[ImagePlausibility]) -> str:
        low, high = min(i.tilt for i in images), max(i.tilt for i in images)
        return f"{low:.0f}–{high:.0f}°" if round(low) != round(high) else f"{low:.0f}°"

    def middles(images: list[ImagePlausibility]) -> str:
        return f"{sum(i.middle_on_terrain for i in images)} of {len(images)} images look at the terrain"

    def axes(alike: float, offset: float) -> str:
        return f"{abs(offset):.0f}° off the flight lines" if alike > 0.85 else "in no relation to the flight lines"

    pairs = [[tell(images) for images in seen] for tell in (tilts, middles)] + [[axes(*each) for each in lines]]
    forms = "tilts are then {1} instead of {0}", "{1} instead of {0}", "image axes are {1} instead of {0}"
    told = [form.format(*pair) for form, pair in zip(forms, pairs) if pair[0] != pair[1]]
    where = "; it is declared to `photoplan init`, or under [orientation] in the project file" if "`" in what else ""
    return f"{what}: {', '.join(told)}{where}"
