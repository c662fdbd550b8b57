"""Three lines of a turbulent flight over rendered hills: the truth of surfaces from strips, ray by ray."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from photoplan.cameras.rpc import fit_rpc
from photoplan.geometry.local import GeodeticGround
from photoplan.io.project.file import load_project
from photoplan.project.cameras import central_without_pixels
from tools.facet_scene import CONTRAST, GROUND, Field, Scene, rendered, waves
from tools.rpc_files import as_text
from tools.shaken_strip import ShakenStrip
from tools.small_block import write_image

CENTRE = (600_000.0, 5_340_000.0)
AHEAD = {"forward": 46.6, "nadir": 0.0, "backward": -46.6}
"""Millimetres in the focal plane by which a line looks ahead."""
#: A piece of lines of 12,000 columns, at the ends of which yaw is told: 0.5 px there, and 15 px in an event.
SHAKEN = ShakenStrip(
    columns=260,
    lines=360,
    origin=CENTRE,
    vibration=(3.0, 0.4, 0.5 * 260 / 12_000),
    events=(40.0, 25.0, 15.0 * 260 / 12_000),
)
CALM = replace(SHAKEN, vibration=(0.0, 0.0, 0.0), events=(0.0, 0.0, 0.0))
GSD = (SHAKEN.flying - GROUND) * SHAKEN.pitch / SHAKEN.focal
HEIGHT_OF_A_PIXEL = GSD * SHAKEN.focal / (2 * AHEAD["forward"])
"""Metres, of the outermost lines."""
#: Heights between which rays are straight lines of the map to a hundredth of a millimetre.
_AROUND = 20.0


def write_strips(
    folder: Path, like: ShakenStrip = SHAKEN, seed: int = 0, snr: float = 50.0, relief: float = 1.0
) -> Scene:
    """The same hills as each line of one flight sees them, one after the other; pixels of 0.29 m.

    Pattern and hills have the sizes, in pixels and in pixels of parallax, of `facet_scene`; or hills `relief` times so
    high.
    """
    rng = np.random.default_rng(seed)
    lengths = np.repeat((80.0, 200.0), 6)
    hills = waves(seed + 1, lengths * GSD, relief * 0.003 * lengths * HEIGHT_OF_A_PIXEL, CENTRE)
    sizes = np.full(64, CONTRAST * np.sqrt(2 / 64))
    pattern = waves(seed + 2, 3.0 * GSD * 12.0 ** np.linspace(0, 1, 64), sizes, CENTRE)
    entries = []
    for number, (name, ahead) in enumerate(AHEAD.items()):
        back = CENTRE[0] - (like.flying - GROUND) * ahead / like.focal
        strip = replace(like, origin=(back, CENTRE[1]), seed=10 * seed + number)
        own = folder / name
        own.mkdir(parents=True)
        text = strip.strip_file(own).read_text()
        (own / "strip.toml").write_text(text.replace("x_mm = [46.6]", f"x_mm = [{ahead}]"))
        pixels = np.mean([_seen(strip, ahead, x, y, hills, pattern) for x in (-0.25, 0.25) for y in (-0.25, 0.25)], 0)
        noisy = np.clip(np.rint(pixels + rng.normal(0, CONTRAST / snr, pixels.shape)), 1, 255)
        write_image(own / "strip.tif", noisy[None].astype(np.uint8))
        detectors = "forward" if ahead else "nadir"
        entries.append(
            f'[[images]]\nname = "{name}"\nfile = "{name}/strip.tif"\n'
            f'line = "{name}/strip.toml"\ndetectors = "{detectors}"\n'
        )
    path = folder / "project.toml"
    terrain = f'[terrain]\nheight = {GROUND}\nheight_system = "ellipsoidal"\n'
    path.write_text(f'format = 1\ncrs = "{like.crs}"\n{terrain}{"".join(entries)}')
    base = 2 * (like.flying - GROUND) * AHEAD["forward"] / like.focal
    return Scene(path, lambda X, Y: GROUND + hills(X, Y), lambda X, Y: 120 + pattern(X, Y), base)


def _seen(
    strip: ShakenStrip, ahead: float, right: float, later: float, hills: Field, pattern: Field
) -> NDArray[np.float64]:
    """Grey values (lines, columns) at parts of a pixel and of a line beside the middles."""
    t = (np.arange(strip.lines) + later - strip.lines / 2) * strip.line_time
    S, R = strip.pose(t)
    y = (np.arange(strip.columns) + 0.5 + right - strip.columns / 2) * strip.pitch
    y = y if ahead else y * (1 - 2e-5 * y**2)
    d = np.stack([np.full_like(y, ahead), y, np.full_like(y, strip.focal)], axis=-1)
    d = np.einsum("nij,cj->nci", R, d / np.linalg.norm(d, axis=1, keepdims=True))
    back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    to_map = Transformer.from_crs("EPSG:4979", strip.crs, always_xy=True)
    feet = []
    for level in (GROUND - _AROUND, GROUND + _AROUND):
        slope = strip.focal / np.hypot(strip.focal, np.hypot(ahead, y))
        r = np.broadcast_to((strip.flying - level) / slope, d.shape[:2])
        for _ in range(5):
            lon, lat, h = back.transform(*np.moveaxis(S[:, None] + r[..., None] * d, -1, 0))
            r = r + (h - level) / slope
        feet.append(np.stack(to_map.transform(lon, lat, h)[:2], axis=-1))
    z = np.zeros(d.shape[:2])
    for _ in range(10):
        XY = feet[0] + ((z + _AROUND) / (2 * _AROUND))[..., None] * (feet[1] - feet[0])
        z = hills(XY[..., 0], XY[..., 1])
    return np.asarray(120 + pattern(XY[..., 0], XY[..., 1]))


def with_others(scene: Scene, seed: int = 9) -> Path:
    """A project of the forward and the nadir line, a frame, a film scan and a satellite image of the same scene."""
    rng = np.random.default_rng(seed)
    lines = scene.path.read_text().partition('[[images]]\nname = "backward"')[0]
    high = SHAKEN.flying - GROUND
    marks = {name: (x, y) for name, (x, y) in zip("abcd", ((-90, -90), (90, -90), (90, 90), (-90, 90)))}
    films = {name: (130.0 + x * 1.3, 130.5 - y * 1.301) for name, (x, y) in marks.items()}
    listed = [", ".join(f"{name} = {list(at)}" for name, at in which.items()) for which in (marks, films)]
    text = f"""
[cameras.digital]
type = "frame"
size = [260, 260]
focal_px = {SHAKEN.focal / SHAKEN.pitch}
[cameras.film]
type = "film"
camera_constant_mm = {SHAKEN.focal / SHAKEN.pitch / 1.3}
fiducials_mm = {{ {listed[0]} }}
size = [260, 260]
"""
    for name, camera, x, y, more in (
        ("frame", "digital", -600.0, 100.0, ""),
        ("film", "film", 100.0, 650.0, f"fiducials = {{ {listed[1]} }}\n"),
        ("satellite", "digital", 700.0, -300.0, ""),
    ):
        angles = np.degrees([-np.arctan2(y, high), np.arctan2(x, np.hypot(y, high)), 0.0])
        center = (CENTRE[0] + x, CENTRE[1] + y, SHAKEN.flying)
        text += f'[[images]]\nname = "{name}"\nfile = "{name}.tif"\ncamera = "{camera}"\n{more}'
        text += f"center = {list(center)}\nangles = {angles.tolist()}\n"
    path = scene.path.with_name("all.toml")
    systems = '[orientation]\nheight_system = "ellipsoidal"\n'
    path.write_text(lines.replace("[[images]]", f"{systems}[[images]]", 1) + text)
    project = load_project(path)
    for name in ("frame", "film", "satellite"):
        camera = central_without_pixels(project, name)
        noisy = np.rint(rendered(camera, scene) + rng.normal(0, CONTRAST / 50, (260, 260)))
        write_image(scene.path.with_name(f"{name}.tif"), np.clip(noisy, 1, 255)[None].astype(np.uint8))
        if name == "satellite":
            fitted = fit_rpc(camera, GeodeticGround(SHAKEN.crs, "ellipsoidal"), (GROUND - 30, GROUND + 30))
            scene.path.with_name("satellite_RPC.TXT").write_text(as_text(fitted.functions))
    before = path.read_text().partition('name = "satellite"')[0]
    path.write_text(f'{before}name = "satellite"\nfile = "satellite.tif"\nrpc = "satellite_RPC.TXT"\n')
    return path
