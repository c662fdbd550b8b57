"""Fault 14: wrong units, orders and axes are noticed, what fits is named, and oblique images are left alone."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.thinned import some

from photoplan.geometry.pose import angles_from_rotation, rotation_from_angles, rotation_opk
from photoplan.io.camera.model import FrameEntry
from photoplan.io.formats import read_cameras, read_orientation
from photoplan.io.project.model import Image, Orientation
from photoplan.io.raster import TerrainReader
from photoplan.orientation.conventions import (
    DECLARED,
    Heights,
    ImagePlausibility,
    JudgedView,
    better_convention,
    look,
    readings,
)
from photoplan.project.cameras import view_of
from photoplan.surfaces.raster import RasterSurface

EAST = np.array([1100.0, 0, 0])
MIDDLE = np.array([700_000.0, 5_300_000.0])
CAMERA = FrameEntry(size=(4000, 3000), focal_px=4000.0)


def hills(XY: np.ndarray) -> np.ndarray:
    """Terrain 4 km × 4 km about the origin, 300 to 340 m high; nothing outside."""
    X, Y = XY[..., 0], XY[..., 1]
    inside = (np.abs(X - 700_000) < 2000) & (np.abs(Y - 5_300_000) < 2000)
    return np.where(inside, 320 + 20 * np.sin(X / 300) * np.cos(Y / 400), np.nan)


def views(
    opk: Any, centers: Any, change: Callable[[np.ndarray], Any] = lambda a: a, order: str = "opk", unit: str = "deg"
) -> list[JudgedView]:
    """Images whose table was written by `change` and is read as `order` and `unit` say."""
    orientation = Orientation.model_validate({"rotation": order, "angle_unit": unit})
    made = []
    for k, (a, c) in enumerate(zip(np.asarray(opk, float), np.asarray(centers, float))):
        angles = tuple(float(v) for v in change(a))
        image = Image(name=f"i{k}", file="i.tif", camera="c", center=tuple(c), angles=angles)
        made.append(view_of(image, CAMERA, orientation, c))
    return made


def strips(heading: float = 30.0, tilt: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Two antiparallel strips of six vertical images, and their centres; the first axis of the image is forwards."""
    rng = np.random.default_rng(5)
    along = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading))])
    across = np.array([-along[1], along[0]])
    centers, opk = [], []
    for strip in (0, 1):
        for k in range(6):
            XY = along * (k - 2.5) * 300 + across * (strip - 0.5) * 500
            centers.append([700_000 + XY[0], 5_300_000 + XY[1], 1500.0])
            opk.append([*rng.normal(0, tilt / 2, 2), heading + 180 * strip + rng.normal(0, 1)])
    return np.array(opk), np.array(centers)


@dataclass(frozen=True)
class Plausibility:
    """What is said of a block of images."""

    images: tuple[ImagePlausibility, ...]
    alternative: str | None

    @property
    def implausible(self) -> tuple[ImagePlausibility, ...]:
        return tuple(i for i in self.images if i.fault is not None)


def assess(block: Sequence[JudgedView], heights: Heights) -> Plausibility:
    """Every image looked at; where something cannot be right, other readings of the whole block."""
    images = tuple(look(view, heights) for view in block)
    return Plausibility(images, better_convention(block, images, heights))


def fails(result: Plausibility) -> str:
    assert result.alternative is not None, result.implausible
    return result.alternative


def test_a_good_block_is_plausible_and_its_figures_are_right() -> None:
    opk, centers = strips()
    result = assess(views(opk, centers), hills)
    assert result.implausible == ()
    assert result.alternative is None
    assert len(result.images) == 12
    for image, a, c in zip(result.images, opk, centers):
        R = rotation_opk(*np.radians(a))
        assert abs(image.tilt - np.degrees(np.arccos(R[2, 2]))) < 1e-9
        down = -R[:, 2]
        assert abs((image.azimuth - np.degrees(np.arctan2(down[0], down[1])) + 180) % 360 - 180) < 1e-6
        assert abs(image.height_above_ground - (c[2] - hills(c[None, :2])[0])) < 1e-9
        assert abs(image.gsd - image.height_above_ground / 4000) < 0.01
        assert image.on_terrain == 1.0
        assert image.middle_on_terrain


@pytest.mark.parametrize(("count", "tilt"), some([*itertools.product((1, 2, 5, 12), (20.0, 45.0, 60.0))], 0, 5, 6))
def test_oblique_images_are_left_alone(tilt: float, count: int) -> None:
    """Looking in all directions, and to one side only."""
    _, centers = strips(heading=0)
    for azimuths in (np.arange(12) * 90.0, np.zeros(12)):
        opk = []
        for azimuth in azimuths:
            # Axis tilted towards `azimuth`, upper side of the image away from the camera.
            a = np.radians(azimuth)
            R = rotation_from_angles([-a, 0, 0], "kpo") @ rotation_opk(np.radians(tilt), 0, 0)
            opk.append(np.degrees(angles_from_rotation(R)))
        result = assess(views(opk, centers)[:count], hills)
        assert result.alternative is None, f"{result.alternative}"
        assert result.implausible == ()
        np.testing.assert_allclose([i.tilt for i in result.images], tilt, atol=1e-6)


def test_a_block_at_the_edge_of_the_terrain_is_left_alone() -> None:
    opk, centers = strips()
    result = assess(views(opk, centers + np.array([2100.0, 0, 0])), hills)
    assert 0 < sum(not i.middle_on_terrain for i in result.images) < 12
    assert result.alternative is None


@pytest.mark.slow
def test_a_heading_askew_to_the_lines_is_left_alone() -> None:
    opk, centers = strips()
    for askew in (20.0, 40.0, -30.0):
        opk[:, 2] = 30 + askew
        assert assess(views(opk, centers), hills).alternative is None


@pytest.mark.slow
def test_irregular_flights_are_left_alone() -> None:
    rng = np.random.default_rng(8)
    for _ in range(4):
        centers = np.column_stack([rng.uniform(-1000, 1000, (14, 2)) + MIDDLE, np.full(14, 900.0)])
        opk = np.column_stack([rng.normal(0, 3, (14, 2)), rng.uniform(-180, 180, 14)])
        assert assess(views(opk, centers), hills).alternative is None


def test_fault_14_gon_read_as_degrees() -> None:
    opk, centers = strips()
    text = fails(assess(views(opk % 360, centers, lambda a: a / 0.9), hills))
    assert "gon" in text
    assert "`angle_unit` gon" in text


def test_fault_14_gon_with_a_half_turn_read_as_degrees() -> None:
    """ω near 200 gon, as Ecker 1991, §8.1 writes vertical images: no unit alone makes it right, unit and axes do."""
    opk, centers = strips()
    opk[:, 0] += 180
    result = assess(views(opk, centers, lambda a: a / 0.9), hills)
    assert len(result.implausible) == 12
    text = fails(result)
    assert "gon" in text
    assert "`angle_unit` gon" in text
    assert "turned by 180°" in text or "y down" in text


def test_fault_14_degrees_read_as_gon_and_radians() -> None:
    opk, centers = strips()
    assert "`angle_unit` deg" in fails(assess(views(opk, centers, unit="gon"), hills))
    assert "`angle_unit` deg" in fails(assess(views(opk, centers, unit="rad"), hills))


def test_fault_14_the_declared_unit_is_the_one_that_is_named() -> None:
    opk, centers = strips()
    text = fails(assess(views((opk + 180) % 360 - 180, centers, np.radians, unit="gon"), hills))
    assert "radians that were declared as gon; declare `angle_unit` rad" in text
    opk, centers = strips(heading=150)
    text = fails(assess(views(opk, centers, lambda a: a / 0.9, unit="rad"), hills))
    assert "gon that were declared as radians; declare `angle_unit` gon" in text


def test_fault_14_radians_read_as_degrees() -> None:
    opk, centers = strips()
    text = fails(assess(views((opk + 180) % 360 - 180, centers, np.radians), hills))
    assert "`angle_unit` rad" in text
    assert "instead of 0°" in text


def test_fault_14_axes_of_computer_vision() -> None:
    opk, centers = strips()

    def flipped(a: np.ndarray) -> np.ndarray:
        return np.degrees(angles_from_rotation(rotation_opk(*np.radians(a)) * (1, -1, -1)))

    result = assess(views(opk, centers, flipped), hills)
    assert len(result.implausible) == 12
    assert "sees nothing of the terrain (tilt 17" in str(result.images[0].fault)
    assert fails(result).startswith("the camera's axes look like y down, z forwards")


def test_fault_14_exchanged_coordinates() -> None:
    opk, centers = strips()
    result = assess(views(opk, centers[:, [1, 0, 2]]), hills)
    assert len(result.implausible) == 12
    assert "X and Y of the projection centres look exchanged" in fails(result)


def test_fault_14_transposed_rotation_of_a_block_in_two_directions() -> None:
    opk, centers = strips(heading=25)
    more, also = strips(heading=50)
    opk, centers = np.concatenate([opk, more]), np.concatenate([centers - EAST, also + EAST])

    def transposed(a: np.ndarray) -> np.ndarray:
        return np.degrees(angles_from_rotation(rotation_opk(*np.radians(a)).T))

    assert "`rotation_direction` ground-to-camera" in fails(assess(views(opk, centers, transposed), hills))


def inwards(order: str) -> tuple[list[list[float]], np.ndarray]:
    """Oblique images around the terrain that look inwards, their angles worked out in `order`, one column each."""
    a = np.radians(np.arange(0, 360, 30.0) + 7)
    centers = np.column_stack([MIDDLE[0] - 2400 * np.sin(a), MIDDLE[1] - 2400 * np.cos(a), np.full(12, 2400.0)])
    rows = []
    for k in a:
        R = rotation_from_angles([-k, 0, 0], "kpo") @ rotation_opk(np.radians(50), 0, 0)
        named = dict(zip(order, np.degrees(angles_from_rotation(R, order))))
        rows.append([named[letter] for letter in "opk"])
    return rows, centers


@pytest.mark.parametrize("order", some(["kpo", "kop", "okp", "pko"], 0))
def test_fault_14_rotation_order_that_sends_oblique_images_elsewhere(order: str) -> None:
    result = assess(views(*inwards(order)), hills)
    assert f"`rotation` {order}" in fails(result)


@pytest.mark.parametrize("order", some(["opk", "pok"], 1))
def test_the_right_order_and_one_that_looks_at_the_terrain_too_claim_nothing(order: str) -> None:
    """What geometry alone cannot tell is not guessed."""
    result = assess(views(*inwards(order)), hills)
    assert result.implausible == ()
    assert result.alternative is None


def test_cameras_below_the_terrain_are_a_question_of_heights() -> None:
    opk, centers = strips()
    result = assess(views(opk, centers - [0, 0, 1250.0]), hills)
    assert all("below the terrain" in (i.fault or "") for i in result.images)
    assert result.alternative is None
    assert sum("height systems" in (i.fault or "") for i in result.implausible) == 12


def test_every_reading_has_a_sentence_and_the_declared_one_none() -> None:
    assert DECLARED.sentence() == ""
    sentences = [r.sentence() for r in readings("opk")]
    assert len(set(sentences)) == len(sentences)
    assert all(sentences)
    assert [r.changes for r in readings("pok")] == sorted(r.changes for r in readings("pok"))
    assert not any(r.order == "pok" for r in readings("pok"))


@pytest.mark.parametrize(
    ("written", "unit", "says"),
    some(
        [
            (lambda a: a, "deg", None),
            (np.radians, "deg", "`angle_unit` rad"),
            (lambda a: a + np.array([180.0, 0, 0]), "deg", "turned by 180°"),
            (np.degrees, "deg", "`angle_unit` deg"),
            (lambda a: a, "rad", "degrees that were declared as radians; declare `angle_unit` deg"),
        ],
        0,
        2,
    ),
)
def test_fault_14_on_the_real_drone_block(
    block: Path, written: Callable[[np.ndarray], Any], unit: str, says: str | None
) -> None:
    """The terrain ends inside this block, so a fifth of its images look past it."""
    camera = next(iter(read_cameras(block / "int.yaml").cameras.values()))
    reader = TerrainReader(block / "dsm.tif")
    assert reader.info.to_map is not None
    x0, xx, _, y0, _, yy = reader.info.to_map
    surface = RasterSurface(reader, (x0, y0), (xx, -yy))
    declared = Orientation.model_validate({"angle_unit": unit})
    made = []
    for line in read_orientation(block / "ext.csv").images:
        angles = tuple(float(v) for v in written(np.array(line.angles)))
        image = Image(name=line.name, file="x.jpg", camera="c", center=line.center, angles=angles)
        made.append(view_of(image, camera, declared, line.center))
    result = assess(made, surface.heights)
    if says is None:
        assert result.implausible == ()
        assert result.alternative is None
        assert 2.0 < np.median([i.tilt for i in result.images]) < 3.0
        scale = [i.gsd * 1434 / i.height_above_ground for i in result.images if i.height_above_ground > 0]
        assert abs(np.median(scale) - 1) < 0.01
    else:
        assert says in fails(result)


def test_terrain_is_never_asked_for_in_a_large_window() -> None:
    """Flat rays reach far; a window around all their points could be the whole of a huge terrain."""
    opk, centers = strips()
    opk[:, 0] = 85

    def careful(XY: np.ndarray) -> np.ndarray:
        assert np.ptp(XY, axis=0).max(initial=0) <= 1000
        return hills(XY)

    assert len(assess(views(opk, centers)[::4], careful).images) == 3
