"""A strip of a turbulent flight, drawn ray by ray over real ground: 50 Hz and two strong events in the angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import Transformer
from scipy import ndimage

from tools.line_strip import Strip, _about, _angles, _convergence, _true_axes

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ShakenStrip(Strip):
    """Every line has a pose of its own, known at the moment of the line; all angles in units of a pixel."""

    vibration: tuple[float, float, float] = (3.0, 0.4, 0.5)
    """Amplitude of 50 Hz in roll, pitch and yaw (at the end of the line), pixels."""
    events: tuple[float, float, float] = (40.0, 25.0, 15.0)
    """Largest turn in roll, pitch and yaw in two events, pixels."""
    event_lines: float = 60.0
    """Width of an event, lines."""
    seed: int = 5

    def shaken(self, t: _Floats) -> _Floats:
        """Roll, pitch and yaw (3, n), radians, beside the slow waves of the flight."""
        rng = np.random.default_rng(self.seed)
        out = np.zeros((3, len(t)))
        line = t / self.line_time
        for k in range(3):
            unit = self.pitch / self.focal if k < 2 else 2.0 / self.columns
            for frequency, part in ((50.0, 0.7), (43.7, 0.3), (23.0, 0.4)):
                phase = rng.uniform(0, 2 * np.pi)
                out[k] += unit * self.vibration[k] * part * np.sin(2 * np.pi * frequency * t + phase)
            for place, sign in ((-0.2, 1.0), (0.23, -1.0)):
                u = (line - place * self.lines) / self.event_lines
                out[k] += unit * self.events[k] * sign * np.exp(-u * u) * np.cos(1.7 * u + k)
        return out

    def pose(self, t: _Floats) -> tuple[_Floats, _Floats]:
        S, R = super().pose(t)
        roll, pitch, yaw = self.shaken(t)
        return S, R @ _about(0, roll) @ _about(1, pitch) @ _about(2, yaw)

    def flown(self) -> _Floats:
        """Times of the lines of the image and of those around it, seconds from the centre."""
        around = max(60, self.lines // 8)
        return (np.arange(-around, self.lines + around) - self.lines / 2) * self.line_time

    def strip_file(self, folder: Path, lever: tuple[float, float, float] = (0.0, 0.0, 0.0), late: float = 0.0) -> Path:
        path = super().strip_file(folder, lever, late)
        t = self.flown()
        S, R = self.pose(t)
        back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
        lon, lat, h = back.transform(*S.T)
        X, Y = Transformer.from_crs("EPSG:4979", self.crs, always_xy=True).transform(lon, lat, h)[:2]
        angles = _angles(_true_axes(lon, lat), R @ np.diag([1.0, -1.0, -1.0]), _convergence(self.crs, lon, lat))
        table = np.column_stack([t + 500, X, Y, h, *angles])
        np.savetxt(folder / "flight.csv", table, "%.12f", ",", header="time,x,y,z,omega,phi,kappa", comments="")
        return path

    def over(self, heights: Callable[[_Floats], _Floats], ahead: float = 0.0) -> _Floats:
        """Map X, Y and height (lines, columns, 3) of what each pixel sees of rolling ground, ray by ray."""
        t = (np.arange(self.lines) - self.lines / 2) * self.line_time
        S, R = self.pose(t)
        y = (np.arange(self.columns) + 0.5 - self.columns / 2) * self.pitch
        y = y if ahead else y * (1 - 2e-5 * y**2)
        d = np.stack([np.full_like(y, ahead), y, np.full_like(y, self.focal)], axis=-1)
        d = np.einsum("nij,cj->nci", R, d / np.linalg.norm(d, axis=1, keepdims=True))
        back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
        to_map = Transformer.from_crs("EPSG:4979", self.crs, always_xy=True)
        r = np.full(d.shape[:2], self.flying - 30.0)
        for _ in range(14):
            lon, lat, h = back.transform(*np.moveaxis(S[:, None] + r[..., None] * d, -1, 0))
            X, Y = to_map.transform(lon, lat, h)[:2]
            ground = heights(np.stack([X, Y], axis=-1))
            r = r + (h - ground)
        return np.stack([X, Y, ground], axis=-1)


@dataclass(frozen=True)
class Vienna:
    """The real orthophoto and terrain, laid down around the flight: values (row, column, band) and heights."""

    data: Path
    """Folder of `vienna_ortho_dtm`."""
    origin: tuple[float, float] = (600_000.0 - 250.0, 5_340_000.0 + 250.0)
    """Upper left corner."""

    def heights(self, XY: _Floats) -> _Floats:
        """Bilinear between posts at the middles of the pixels of 1 m, (...)."""
        with rasterio.open(self.data / "44_2_dgm.tif") as file:
            grid = file.read(1).astype(float)
        at = np.stack([(self.origin[1] + 10.5 - XY[..., 1]) - 0.5, (XY[..., 0] - self.origin[0] + 10.5) - 0.5])
        return np.asarray(ndimage.map_coordinates(grid, at, order=1, mode="nearest"))

    def grey(self, XY: _Floats) -> _Floats:
        """Green of the orthophoto, by cubic splines, (...)."""
        with rasterio.open(self.data / "44_2_op_2023_30cm.tif") as file:
            grid = ndimage.gaussian_filter(file.read(2).astype(float), 0.7)
        at = np.stack([(self.origin[1] - XY[..., 1]) / 0.3 - 0.5, (XY[..., 0] - self.origin[0]) / 0.3 - 0.5])
        return np.asarray(ndimage.map_coordinates(grid, at, order=3, mode="mirror"))

    def write_terrain(self, path: Path, crs: str) -> None:
        """The terrain as a raster of its own place."""
        with rasterio.open(self.data / "44_2_dgm.tif") as file:
            grid = file.read(1)
        transform = rasterio.Affine(1.0, 0.0, self.origin[0] - 10.5, 0.0, -1.0, self.origin[1] + 10.5)
        profile = {"driver": "GTiff", "height": grid.shape[0], "width": grid.shape[1], "count": 1, "dtype": grid.dtype}
        with rasterio.open(path, "w", crs=crs, transform=transform, **profile) as file:
            file.write(grid, 1)
