"""`photoplan surface --target vault:…, column:…`: heights over a cylinder, from inside and outside, rendered."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from products.test_surface import places
from products.test_surface_target import points
from tools.command import inside
from tools.facet_scene import CONTRAST, waves
from tools.small_block import CRS, X0, Y0, write_image

from photoplan.cameras.framed import FramedCamera
from photoplan.geometry.frames import CylinderFrame
from photoplan.geometry.pose import angles_from_rotation
from photoplan.io.project.file import load_project
from photoplan.matching.facets.observe import Facets, Pyramid, Relief, View, look
from photoplan.project.cameras import central_without_pixels

SIZE, FOCAL, AXIS, RADIUS, U = 110, 300.0, (X0, Y0, 100.0), 5.0, 2.0
#: Of cameras before the place u = U, v = 0: metres to the right and up of it; and away from it.
ASIDE, AWAY = ((-1.5, -0.8), (0.2, 0.0), (1.5, 0.8)), 4.5
GSD = AWAY / FOCAL
HEIGHT_OF_A_PIXEL = GSD * AWAY / float(np.hypot(3.0, 1.6))
RELIEF = waves(1, np.repeat((1.2, 3.0), 6), np.repeat((1.2, 3.0), 6) / 100, (0.0, 0.0))
PATTERN = waves(2, 3 * GSD * 12.0 ** np.linspace(0, 1, 64), np.full(64, CONTRAST * np.sqrt(2 / 64)), (0.0, 0.0))


def over(origin: np.ndarray, way: np.ndarray, frame: CylinderFrame) -> tuple[np.ndarray, np.ndarray]:
    """Arc and place along the axis where rays (n, 3) meet the relief."""
    sign = -1.0 if frame.inside else 1.0
    axis, middle = np.array(frame.axis), np.array(frame.middle)
    right = sign * np.cross(axis, middle)
    p, d = (np.stack([a @ middle, a @ right, a @ axis], axis=-1) for a in (origin - AXIS, way))
    h = np.zeros(len(d))
    for _ in range(12):
        a, b = (d[:, :2] ** 2).sum(axis=1), d[:, :2] @ p[:2]
        along = (-b - sign * np.sqrt(b * b - a * (p[:2] @ p[:2] - (RADIUS + sign * h) ** 2))) / a
        at = p + along[:, None] * d
        u, v = RADIUS * np.arctan2(at[:, 1], at[:, 0]), at[:, 2]
        h = RELIEF(u, v)
    return u, v


def write(folder: Path, frame: CylinderFrame, orientation: str = "") -> Path:
    """A project of three images of the relief on a cylinder."""
    rng = np.random.default_rng(3)
    right, up, out = frame.jacobian((U, 0.0, 0.0)).T
    text = f'format = 1\ncrs = "{CRS}"\n[terrain]\nheight = {AXIS[2]}\nheight_system = "same"\n'
    text += f'[orientation]\nheight_system = "same"\n{orientation}'
    text += f'[cameras.c]\ntype = "frame"\nsize = [{SIZE}, {SIZE}]\nfocal_px = {FOCAL}\n'
    for number, (x, y) in enumerate(ASIDE):
        center = frame((U, 0.0, 0.0)) + x * right + y * up + AWAY * out
        back = center - frame((U, 0.0, 0.0))
        back /= np.linalg.norm(back)
        first = np.cross(up, back)
        first /= np.linalg.norm(first)
        G = np.column_stack([first, np.cross(back, first), back])
        values = np.zeros((SIZE, SIZE))
        for part in ((i, j) for i in (-0.25, 0.25) for j in (-0.25, 0.25)):
            col, row = np.meshgrid(np.arange(SIZE) + part[0], np.arange(SIZE) + part[1])
            way = np.stack([col - (SIZE - 1) / 2, (SIZE - 1) / 2 - row, np.full_like(col, -FOCAL)], axis=-1) @ G.T
            values += PATTERN(*over(center, way.reshape(-1, 3), frame)).reshape(SIZE, SIZE) / 4
        noisy = np.clip(np.rint(120 + values + rng.normal(0, CONTRAST / 50, values.shape)), 1, 255)
        write_image(folder / f"i{number}.tif", noisy[None].astype(np.uint8))
        text += f'[[images]]\nname = "i{number}"\nfile = "i{number}.tif"\ncamera = "c"\ncenter = {center.tolist()}\n'
        text += f"angles = {np.degrees(angles_from_rotation(G)).tolist()}\n"
    path = folder / "project.toml"
    path.write_text(text)
    return path


def judged(folder: Path) -> tuple[float, float, float]:
    """Share of heights, rms error in pixels of parallax, rms of normalised errors."""
    found, u, v = places(folder / "surface.tif")
    sigma, *_ = places(folder / "surface_sigma.tif")
    known = np.isfinite(found)
    off = (found - RELIEF(u, v))[known]
    told = known.mean(), np.sqrt(np.mean(off**2)) / HEIGHT_OF_A_PIXEL, np.sqrt(np.mean((off / sigma[known]) ** 2))
    print(*told, "bias", off.mean() / HEIGHT_OF_A_PIXEL)
    return told


@pytest.mark.parametrize(
    ("frame", "target"),
    [
        pytest.param(CylinderFrame.vault(AXIS, 20.0, RADIUS, 5.0), f"vault:{X0},{Y0},100,20,5,5", id="vault"),
        pytest.param(
            CylinderFrame.column(AXIS, 110.0, RADIUS),
            f"column:{X0},{Y0},100,110,5",
            id="column",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_heights_over_a_cylinder_are_radial(tmp_path: Path, frame: CylinderFrame, target: str) -> None:
    project = write(tmp_path, frame)
    words = ["--resolution", 3 * GSD, "--bounds", U - 0.4, -0.4, U + 0.4, 0.4, "--reach", 0.12, "--no-search"]
    said = inside("surface", project, "--target", target, *words, "--no-quicklook", "--workers", 1,
                  "--points", tmp_path / "p.ply")  # fmt: skip
    assert said.code == 0, said.err
    share, rms, normalised = judged(tmp_path / "products")
    assert share == 1.0 and rms < 0.02 and 0.6 < normalised < 1.4
    # Points are on the ground: their distances from the axis are those of the relief.
    ground = np.array(points(tmp_path / "p.ply")["xyz"])
    u, v, h = frame.inverse(ground).T
    axis = np.array(frame.axis)
    from_axis = np.linalg.norm(np.cross(ground - AXIS, axis), axis=1)
    assert from_axis == pytest.approx(RADIUS + (-h if frame.inside else h)) and len(h) > 200
    assert np.sqrt(np.mean((h - RELIEF(u, v)) ** 2)) < 0.03 * HEIGHT_OF_A_PIXEL


def test_rays_bend_over_a_cylinder_as_they_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than a parabola within the heights that a surface may have: by 0.05 of a grey facet."""
    monkeypatch.setattr(sys.modules[__name__], "PATTERN", lambda u, v: np.zeros_like(u))
    frame = CylinderFrame.column(AXIS, 110.0, RADIUS)
    project = load_project(write(tmp_path, frame))
    around = U - 0.4, -0.4, U + 0.4, 0.4
    facets = Facets(left=around[0], top=around[3], pitch=3 * GSD, shape=(19, 19), ratio=3)
    heights = RELIEF(*np.moveaxis(facets.posts, -1, 0))
    image = SimpleNamespace(size=(SIZE, SIZE), read=lambda window: np.zeros((window.height, window.width), np.float32))
    for name in ("i0", "i2"):
        camera = central_without_pixels(project, name)
        view = View(camera=FramedCamera(camera, frame, around), pyramid=Pyramid(image))
        sight = look(view, 0, facets, (heights.min() - 0.4, heights.max() + 0.3))
        assert sight is not None
        places = sight.onto(Relief.of(heights)).places[..., :2]
        col, row = np.meshgrid(*(first + np.arange(n) for first, n in zip(sight.first, places.shape[1::-1])))
        origin, way = camera.rays(np.stack([col, row], axis=-1).reshape(-1, 2).astype(float))
        true = facets.to_posts(np.stack(over(origin[0], way, frame), axis=-1)).reshape(places.shape)
        off = np.abs(places - true)[np.isfinite(places[..., 0])] * facets.ratio
        print(off.mean(), off.max())
        # Facets of 45 mm over hills of 1.2 m take 0.01 of it.
        assert len(off) > 2000 and off.mean() < 0.003 and off.max() < 0.015


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7, 10])
def test_standard_deviations_over_a_column_hold_for_other_reliefs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """With rays that bend as a parabola 2.4 each."""
    lengths = np.repeat((1.2, 3.0), 6)
    here = sys.modules[__name__]
    monkeypatch.setattr(here, "RELIEF", waves(seed, lengths, lengths / 100, (0.0, 0.0)))
    sizes = np.full(64, CONTRAST * np.sqrt(2 / 64))
    monkeypatch.setattr(here, "PATTERN", waves(seed + 1, 3 * GSD * 12.0 ** np.linspace(0, 1, 64), sizes, (0.0, 0.0)))
    project = write(tmp_path, CylinderFrame.column(AXIS, 110.0, RADIUS))
    words = ["--resolution", 3 * GSD, "--bounds", U - 0.4, -0.4, U + 0.4, 0.4, "--reach", 0.12, "--no-search"]
    said = inside("surface", project, "--target", f"column:{X0},{Y0},100,110,5", *words, "--no-quicklook")
    assert said.code == 0, said.err
    share, rms, normalised = judged(tmp_path / "products")
    assert share == 1.0 and rms < 0.012 and 0.6 < normalised < 1.3
