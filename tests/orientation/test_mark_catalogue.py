"""Every kind of mark is found again where it was drawn: at any sub-pixel place, turned, in noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from scipy import ndimage
from tools.thinned import some, thinned

from photoplan.cameras.fiducials import MarkExample, MarkPattern
from photoplan.cameras.marks import Mark, disc, turned
from photoplan.errors import InputError
from photoplan.orientation.marks.locate import coverage, locate_mark, render
from photoplan.orientation.marks.single import find_mark, fit_edges, pattern_edges

SNR = 20.0
SCALE = 40.0
BLUR = 0.9


def mark(kind: str, **entries: Any) -> MarkPattern:
    made: MarkPattern = TypeAdapter(Mark).validate_python({"type": kind, **entries}).pattern()
    return made


SQUARES = [[(0.0, 0.0), (s, 0.0), (s, s), (0.0, s)] for s in (0.8, -0.8)]
FREE = {
    "cross": mark("cross", arm=1.0, width=0.12),
    "open cross": mark("cross", arm=1.0, width=0.12, free=0.25, rotation=45.0),
    "dot": mark("dot", diameter=0.4),
    "dark dot": mark("dot", diameter=0.4, bright=False),
    "ring": mark("ring", diameter=0.9, width=0.12),
    "ring_cross": mark("ring_cross", diameter=1.2, width=0.1, arm=0.45, rotation=45.0),
    "dot_cross": mark("dot_cross", diameter=0.3, arm=0.8, width=0.1, free=0.3),
    "checkerboard": mark("polygon", parts=[{"outline": each, "tone": 1.0} for each in SQUARES], background=0.0),
}
BLOCK = {"ledge": 2.6, "depth": 1.5, "tip": 1.6, "height": 2.4}


def silhouettes(**more: float | bool) -> dict[str, MarkPattern]:
    return {
        "block": mark("block", **BLOCK, **more),
        "slit block": mark("block", **BLOCK, slit=0.1, **more),
        "curve": mark("curve", ledge=2.6, depth=1.8, rise=2.6, run=3.4, **more),
        "notch": mark("notch", reach=2.5, tip=1.9, shoulder=2.1, **more),
        "triangle": mark("triangle", flanks=(225.0, 312.0), near=0.3, far=2.6, **more),
        "arc": mark("arc", arm=1.0, width=0.1, tip=3.0, depth=2.0, rise=3.0, run=4.0, **more),
    }


def matrix(degrees: float, scale: float = SCALE) -> NDArray[np.float64]:
    a = math.radians(degrees)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    return scale * np.diag([1.0, -1.0]) @ turn


def scene(
    pattern: MarkPattern, to_pixel: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float32], float, float]:
    """A scan of 100 grey values of contrast with noise, and where the mark is in it; the unknown ground is mid-grey."""
    offset = rng.uniform(-0.5, 0.5, 2)
    drawn = render(pattern, to_pixel, blur_px=BLUR, offset=(float(offset[0]), float(offset[1])))
    margin = 12
    grey = np.where(drawn.weights > 0, drawn.values, 0.6)
    grey = np.pad(grey, margin, mode="edge")
    noisy = 60 + 100 * grey + rng.normal(0, 100 / SNR, grey.shape)
    return noisy.astype(np.float32), drawn.reference[0] + margin, drawn.reference[1] + margin


def frame_scene(
    pattern: MarkPattern, to_pixel: NDArray[np.float64], rng: np.random.Generator, texture: float = 0.1
) -> tuple[NDArray[np.float32], float, float]:
    """The same of a whole frame: exact areas of its outline, image content that differs from photo to photo."""
    template = render(pattern, to_pixel)
    shape = (template.values.shape[0] + 24, template.values.shape[1] + 24)
    x, y = np.array(template.reference) + 12 + rng.uniform(-0.5, 0.5, 2)
    if pattern.name == "triangle":
        a = np.radians((225.0, 312.0))
        wedge = np.stack([np.cos(a), np.sin(a)], axis=1) * 50
        outlines = [(np.vstack([(0.0, 0.0), wedge]), 0.0)]
    else:
        tones = [part.tone for part in pattern.parts]
        last = max(k for k, tone in enumerate(tones) if math.isnan(tone))
        outlines = [(part.outline, part.tone) for part in (pattern.parts[0], *pattern.parts[last + 1 :])]
    grey = np.ones(shape)
    for outline, tone in outlines:
        share = coverage(outline @ to_pixel.T + (x, y), shape)
        grey = grey * (1 - share) + tone * share
    content = ndimage.gaussian_filter(rng.normal(size=shape), 3.0)
    grey = ndimage.gaussian_filter(grey * (1 + texture * content / content.std()), BLUR)
    return (60 + 100 * grey + rng.normal(0, 100 / SNR, shape)).astype(np.float32), float(x), float(y)


def rms(errors: list[tuple[float, float]]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("kind", FREE)
def test_a_free_mark_is_found_to_a_twentieth_of_a_pixel(kind: str) -> None:
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(6):
        to_pixel = matrix(rng.uniform(-180, 180))
        image, x, y = scene(FREE[kind], to_pixel, rng)
        found = locate_mark(image, FREE[kind], to_pixel, blur_px=BLUR)
        assert found.correlation > 0.8
        errors.append((found.x - x, found.y - y))
    assert rms(errors) <= 0.05, errors


@pytest.mark.parametrize("kind", some(silhouettes(), 0, 3))
@pytest.mark.parametrize(
    ("side", "texture", "limit"),
    [
        pytest.param(0.0, 0.0, 0.05, marks=pytest.mark.slow),
        (90.0, 0.1, 0.1),
        pytest.param(270.0, 0.0, 0.05, marks=pytest.mark.slow),
    ],
)
@thinned("scans", 1, 3)
def test_a_silhouette_is_found_by_its_edges(kind: str, side: float, texture: float, limit: float, scans: int) -> None:
    rng = np.random.default_rng(int(side))
    mirrored = bool(rng.integers(2)) and kind != "triangle"
    pattern = silhouettes(rotation=0.0 if kind == "triangle" else side, mirrored=mirrored)[kind]
    errors = []
    for _ in range(scans):
        degrees = rng.uniform(-0.8, 0.8)
        image, x, y = frame_scene(pattern, matrix(degrees), rng, texture)
        found = find_mark(image, pattern, matrix(0.0))
        assert found.accepted, found.refused
        assert found.method == "edges"
        assert found.edges is not None
        assert math.degrees(found.edges.rotation) == pytest.approx(degrees, abs=1.6)
        errors.append((found.x - x, found.y - y))
    assert rms(errors) <= limit, errors


@pytest.mark.parametrize("inside", [None, 0.3])
def test_frame_and_image_meet_without_a_seam(inside: float | None) -> None:
    x, y = 0.37, -0.21
    pattern = mark("block", **BLOCK, inside=inside)
    drawn = render(pattern, matrix(7.0), blur_px=0.0, offset=(x, y))
    whole = mark("block", **BLOCK).parts[0].outline
    exact = 1 - coverage(whole @ matrix(7.0).T + np.array(drawn.reference), drawn.values.shape)
    seen = drawn.weights > 0.99
    edge = seen & (exact > 0.1) & (exact < 0.9)
    assert edge.sum() > 100
    # Pixels at the border of a corner that is left out hold some of it.
    assert np.quantile(np.abs(drawn.values - exact)[edge], 0.95) < 1e-5


@thinned("count", 12, 40)
def test_standard_deviations_of_edges_are_those_of_their_errors(count: int) -> None:
    rng = np.random.default_rng(3)
    pattern = silhouettes()["block"]
    normalised = []
    for _ in range(count):
        image, x, y = frame_scene(pattern, matrix(0.3), rng)
        found = fit_edges(image, pattern, matrix(0.0), (x + rng.uniform(-2, 2), y + rng.uniform(-2, 2)))
        assert found is not None
        normalised += [(found.x - x) / found.sigma_x, (found.y - y) / found.sigma_y]
    assert 0.7 < np.std(normalised) < 1.4


def test_edges_are_where_both_sides_are_described() -> None:
    edges = pattern_edges(mark("dot", diameter=2.0), 0.05)
    radius = np.hypot(*edges.points.T)
    np.testing.assert_allclose(radius, 1.0, atol=2e-3)
    np.testing.assert_allclose(edges.normals, -edges.points / radius[:, None], atol=0.05)  # from dark to bright
    wedge = mark("triangle", flanks=(200.0, 340.0), near=0.5, far=2.0)
    points = pattern_edges(wedge, 0.05).points
    angle = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    assert np.minimum(np.abs(angle - 200), np.abs(angle - 340)).max() < 1e-6
    assert len(points) == pytest.approx(2 * 1.5 / 0.05, abs=4)  # every point once


def test_a_negative_has_the_same_edges() -> None:
    pattern = silhouettes()["notch"]
    image, x, y = frame_scene(pattern, matrix(0.0), np.random.default_rng(5))
    right = fit_edges(-image, pattern, matrix(0.0), (x + 1, y - 1), negative=True)
    assert right is not None
    assert math.hypot(right.x - x, right.y - y) < 0.1
    wrong = fit_edges(-image, pattern, matrix(0.0), (x + 1, y - 1))
    assert wrong is None or wrong.used < 0.6 or wrong.rms > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4])
def test_where_there_is_no_mark_none_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    content = ndimage.gaussian_filter(rng.normal(size=(200, 220)), 4.0)
    image = (100 + 30 * content / content.std() + rng.normal(0, 4, content.shape)).astype(np.float32)
    for pattern in (*silhouettes().values(), *FREE.values()):
        assert not find_mark(image, pattern, matrix(0.0)).accepted, pattern.name


def test_two_equal_marks_are_refused() -> None:
    image, _, _ = scene(FREE["cross"], matrix(0.0), np.random.default_rng(2))
    found = find_mark(np.hstack([image, image]), FREE["cross"], matrix(0.0), blur_px=BLUR)
    assert not found.accepted
    assert "nearly as well" in found.refused


def test_a_window_smaller_than_the_mark_is_refused() -> None:
    found = find_mark(np.zeros((20, 20), np.float32), FREE["cross"], matrix(0.0))
    assert not found.accepted
    assert math.isnan(found.x)


def test_an_example_is_found_turned_and_mirrored() -> None:
    rng = np.random.default_rng(11)
    pattern = silhouettes()["block"]
    image, x, y = frame_scene(pattern, matrix(0.0), rng, texture=0.02)
    example = MarkExample("cut", image[14:-14, 14:-14], (x - 14, y - 14), 1 / SCALE)
    for degrees, mirrored in ((0.0, False), (90.0, True), (270.0, False)):
        to_pixel = matrix(degrees) @ np.diag([-1.0 if mirrored else 1.0, 1.0])
        other, u, v = frame_scene(pattern, to_pixel, rng, texture=0.02)
        found = find_mark(other, example, to_pixel, rotations=(0.0,))
        assert found.accepted, found.refused
        assert math.hypot(found.x - u, found.y - v) <= 0.07


def test_the_area_of_a_disc_is_that_of_a_circle() -> None:
    x, y = disc(2.0).T
    assert abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2 == pytest.approx(np.pi, rel=1e-12)


def test_turning_is_anticlockwise_and_mirroring_exchanges_left_and_right() -> None:
    np.testing.assert_allclose(turned(np.array([(1.0, 0.0)]), 90.0), [(0.0, 1.0)], atol=1e-15)
    tip, flipped = mark("block", **BLOCK), mark("block", **BLOCK, mirrored=True)
    assert flipped.window == pytest.approx((-tip.window[2], tip.window[1], -tip.window[0], tip.window[3]))


@pytest.mark.parametrize(
    ("kind", "entries", "message"),
    [
        ("cross", {"arm": 1.0, "width": -0.1}, "cross.width\n.*greater than 0"),
        ("cross", {"arm": 1.0, "width": 0.1, "free": 1.0}, "free < arm"),
        ("ring", {"diameter": 1.0, "width": 0.5}, "less than half of the diameter"),
        ("dot_cross", {"diameter": 3.0, "arm": 1.0, "width": 0.1}, "must show outside"),
        ("dot", {"diameter": 0.5, "margin": -1.0}, "dot.margin\n"),
        ("polygon", {"parts": [{"outline": [(0.0, 0.0), (0.0, 0.0)], "tone": 1.0}]}, "at least 3 items"),
        ("polygon", {"parts": [{"outline": SQUARES[0], "tone": 1.5}]}, "tone\n.*less than or equal to 1"),
        ("polygon", {"parts": [{"outline": SQUARES[0], "tone": 1.0}], "background": 1.0}, "one tone"),
        ("block", {"ledge": 1.0, "depth": 1.0, "tip": 0.0, "height": 1.0}, "block.tip\n.*greater than 0"),
        ("notch", {"reach": 3.0, "tip": 0.5, "shoulder": 1.0}, "flanks must be longer"),
        ("triangle", {"flanks": (90.0, 80.0), "near": 0.0, "far": 1.0}, "angle under 180"),
        ("block", {**BLOCK, "band": 0.0}, "block.band\n.*greater than 0"),
    ],
)
def test_impossible_marks_are_refused(kind: str, entries: dict[str, Any], message: str) -> None:
    with pytest.raises((InputError, ValidationError), match=message):
        mark(kind, **entries)
