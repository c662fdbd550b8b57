"""Lines and points in views: what is seen of them, against lines of sight that are sampled densely."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from surfaces.test_seen import BOUNDS, MIDDLE, hills, looking, near
from tools.function_surface import raster_surface

from photoplan.cameras.curvature import EarthBend
from photoplan.kernels.jit import COMPILED
from photoplan.kernels.raster import draw_lines
from photoplan.surfaces.seen import Lines, LinesOfSight, SeenLines, SeenSurface
from photoplan.targets.view import FrameBundle, Panorama, ViewTarget

pytestmark = pytest.mark.skipif(not COMPILED, reason="thousands of rays")

TERRAIN = raster_surface(hills(), 600_000.0, 5_200_000.0, 25.0)
EYE = near(-260, -240, 395)
CAMERA = looking(EYE, near(0, 0, 300), focal=300, size=(400, 260))
TARGETS = {
    "flat": ViewTarget.of_camera(CAMERA),
    "round": ViewTarget(FrameBundle(CAMERA), CAMERA.center, (EarthBend((EYE[0], EYE[1]), 4e-5),), 4e-5),
    "panorama": ViewTarget(Panorama(CAMERA.center, (1600, 300), 2.6, 1600 / (2 * np.pi), 100.0), CAMERA.center),
}
BENDS = {"flat": 0.0, "round": 4e-5, "panorama": 0.0}
#: A line over hills and valleys, and one that leaves the terrain and comes back.
WAYS = (((-200, -260), (250, 40), (-120, 270)), ((-270, 200), (-340, 0), (280, 120)))


def sight(name: str) -> LinesOfSight:
    return LinesOfSight(TARGETS[name], SeenSurface(TERRAIN, BOUNDS))


def lines() -> Lines:
    XYZ = [(*(MIDDLE[:2] + at), np.nan) for way in WAYS for at in way]
    return Lines(np.array(XYZ), np.repeat(np.arange(2), 3))


def clearance(places: np.ndarray, bend: float) -> np.ndarray:
    """Least height of the line of sight above ground before it gets near a place, by the distance: in radians."""
    t = np.linspace(0.0, 1.0, 2501)[:, None, None]
    way = EYE + t * (places - EYE)
    s2 = ((places - EYE)[:, :2] ** 2).sum(axis=1)
    z = way[..., 2] + bend * s2 * (t[..., 0] ** 2 - t[..., 0])
    return np.nanmin((z - TERRAIN.heights(way[..., :2]))[:-2], axis=0) / np.sqrt(s2)


def apart(uv: np.ndarray, seen: SeenLines) -> np.ndarray:
    """Distance of pixels (n, 2) from the pieces."""
    a, b = seen.uv[:-1], seen.uv[1:]
    use = seen.piece[1:] == seen.piece[:-1]
    a, way = a[use], (b - a)[use]
    t = np.clip(((uv[:, None] - a) * way).sum(-1) / np.maximum((way**2).sum(-1), 1e-12), 0, 1)
    return np.linalg.norm(uv[:, None] - a - t[..., None] * way, axis=-1).min(axis=1)


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_seen_of_a_line_is_what_lines_of_sight_reach(name: str) -> None:
    view, drawn = sight(name), lines()
    seen = view.lines(drawn)
    clear = hidden = 0
    for k in range(2):
        own = SeenLines(seen.uv[np.isin(seen.piece, np.flatnonzero(seen.line == k))], seen.piece[
            np.isin(seen.piece, np.flatnonzero(seen.line == k))], seen.line)  # fmt: skip
        way = drawn.XYZ[drawn.line == k, :2]
        at = np.concatenate([a + np.linspace(0, 1, 100)[:, None] * (b - a) for a, b in pairwise(way)])
        places = np.column_stack([at, TERRAIN.heights(at)])
        places = places[np.isfinite(places[:, 2])]
        uv = view.target.to_view(places)[:, :2]
        inside = view.inside(uv, -3.0)
        places, uv = places[inside], uv[inside]
        free, away = clearance(places, BENDS[name]), apart(uv, own)
        # A pixel is 1/300 (panorama: 1/255) radian. What is hidden by more than a pixel is not drawn, what has the way
        # clear is, to a tenth of a pixel.
        sure, out = free > 0, free < -0.004
        assert away[sure].max() < 0.1
        assert (away[out] > 0.3).mean() > 0.9, "another part of the line may run there in the picture"
        clear, hidden = clear + int(sure.sum()), hidden + int(out.sum())
    assert clear > 40 and hidden > 30


def test_a_pole_behind_a_hill_is_cut_where_the_hill_ends() -> None:
    """The upper end of what is hidden, by halving lines of sight."""
    view = sight("flat")
    foot = np.add(MIDDLE[:2], (100.0, 80.0))
    low, high = 280.0, 600.0
    drawn = view.lines(Lines(np.array([(*foot, low), (*foot, high)]), np.zeros(2, np.int64)))
    a, b = low, high
    for _ in range(40):
        z = (a + b) / 2
        free = clearance(np.array([(*foot, z)]), 0.0)[0] > 0
        a, b = (a, z) if free else (z, b)
    wanted = view.target.to_view(np.array([(*foot, b)]))[0, :2]
    assert TERRAIN.heights(foot) + 5 < b < 400, "some of it is hidden"
    assert np.abs(drawn.uv - wanted).sum(axis=1).min() < 0.2 and drawn.uv[:, 1].max() < wanted[1] + 0.2


def test_points_are_seen_or_hidden_and_lines_that_pass_the_eye_end() -> None:
    view = sight("flat")
    tops = np.argwhere(hills() > 345)
    XYZ = np.column_stack([600_000 + 25.0 * tops[:, 1], 5_200_000 - 25.0 * tops[:, 0], np.full(len(tops), np.nan)])
    found = view.points(XYZ)
    free = clearance(found.XYZ, 0.0)
    inside = view.inside(found.uv)
    assert found.shown[inside & (free > 0)].all() and not found.shown[inside & (free < -0.01)].any()
    through = np.array([EYE - (100, 30, 0), np.add(EYE, (100, 30, 0))])
    assert len(view.lines(Lines(through, np.zeros(2, np.int64))).uv) < 100_000


def test_a_line_round_the_back_of_a_panorama_is_not_drawn_across_it() -> None:
    view = sight("panorama")
    ring = np.linspace(0, 2 * np.pi, 90)
    XYZ = np.column_stack([EYE[0] + 20 * np.cos(ring), EYE[1] + 20 * np.sin(ring), np.full(90, EYE[2] + 1)])
    seen = view.lines(Lines(XYZ, np.zeros(90, np.int64)))
    steps = np.abs(np.diff(seen.uv[:, 0]))[np.diff(seen.piece) == 0]
    assert steps.max() < 3 and seen.uv[:, 0].min() < 3 and seen.uv[:, 0].max() > 1597


@pytest.mark.parametrize("width", [0.4, 1.0, 1.5, 3.0, 7.3])
def test_a_line_has_its_width_at_any_angle(width: float) -> None:
    for angle in np.radians([0, 7, 31, 45, 77, 90]):
        for shift in (0.0, 0.37):
            way = 60 * np.array([np.cos(angle), np.sin(angle)])
            ends = np.concatenate([np.subtract((50 + shift, 50), way), np.add((50 + shift, 50), way)])
            cover = np.zeros((101, 101), np.float32)
            draw_lines(ends[None], width, cover)
            # What is covered of the middle, by the length of the line in it.
            along = (np.stack(np.mgrid[:101, :101][::-1], axis=-1) - (50 + shift, 50)) @ (way / 60)
            inner = np.clip(30.5 - np.abs(along), 0, 1)
            assert (cover * inner).sum() / 60 - (width) == pytest.approx(0, abs=0.1 if width >= 1 else 0.05)
