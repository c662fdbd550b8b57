"""A strip of a line camera over the map, its ISD and its image of a known ground: no code of photoplan draws it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj import Proj, Transformer


@dataclass(frozen=True)
class Strip:
    """A flight along +X of UTM 33, rolled and pitched by slow waves; focal plane in millimetres, times in seconds."""

    columns: int = 400
    lines: int = 600
    flying: float = 3000.0
    focal: float = 100.0
    pitch: float = 0.01
    speed: float = 70.0
    origin: tuple[float, float] = (600_000.0, 5_340_000.0)
    waves: float = 0.004
    centre_time: float = 1000.0
    #: Seconds by which the support data begin before the middle of the first line and end after that of the last.
    beyond: float = 0.5

    @property
    def crs(self) -> str:
        return "EPSG:32633"

    @property
    def pixel(self) -> float:
        """Pixel on the ground, metres."""
        return self.flying * self.pitch / self.focal

    @property
    def line_time(self) -> float:
        return self.pixel / self.speed

    def pose(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Geocentric positions (n, 3) and rotations (n, 3, 3), camera to earth, at seconds from the centre."""
        to_earth = Transformer.from_crs(self.crs, "EPSG:4979", always_xy=True)
        to_axes = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
        X, Y = self.origin[0] + self.speed * t, np.full_like(t, self.origin[1])
        lon, lat, h = to_earth.transform(X, Y, np.full_like(t, self.flying))
        S = np.column_stack(to_axes.transform(lon, lat, h))
        lon0, lat0 = np.radians(lon.mean()), np.radians(lat.mean())
        s, c, sl, cl = np.sin(lon0), np.cos(lon0), np.sin(lat0), np.cos(lat0)
        east, north = np.array([-s, c, 0.0]), np.array([-sl * c, -sl * s, cl])
        up = np.array([cl * c, cl * s, sl])
        # Axes of the camera at rest: x along the flight (east), y to the right (south), z down.
        rest = np.column_stack([east, -north, -up])
        roll, pitch, yaw = (self.waves * np.sin(w * t + p) for w, p in ((0.9, 0.0), (0.7, 1.0), (0.4, 2.0)))
        return S, np.einsum("ij,njk->nik", rest, _about(0, roll) @ _about(1, pitch) @ _about(2, yaw))

    def isd(self) -> dict[str, object]:
        """Support data as CSM has them."""
        span = self.lines * self.line_time
        t = np.linspace(-span / 2 - self.beyond, span / 2 - self.line_time + self.beyond, 400)
        S, R = self.pose(t)
        q = np.array([_quaternion(each.T) for each in R])
        times = (t + self.centre_time).tolist()
        return {
            "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",
            "image_lines": self.lines,
            "image_samples": self.columns,
            "center_ephemeris_time": self.centre_time,
            "line_scan_rate": [[0.5, -span / 2 - 0.5 * self.line_time, self.line_time]],
            "radii": {"semimajor": 6378.137, "semiminor": 6356.752314245179, "unit": "km"},
            "detector_sample_summing": 1,
            "detector_center": {"line": 0.0, "sample": self.columns / 2},
            "starting_detector_line": 0,
            "starting_detector_sample": 0,
            "focal2pixel_lines": [0.0, 1 / self.pitch, 0.0],
            "focal2pixel_samples": [0.0, 0.0, 1 / self.pitch],
            "focal_length_model": {"focal_length": self.focal},
            "optical_distortion": {"radial": {"coefficients": [0.0, 2e-5, 0.0]}},
            "instrument_position": {"unit": "m", "positions": S.tolist(), "ephemeris_times": times},
            "instrument_pointing": {"quaternions": q.tolist(), "ephemeris_times": times},
            "body_rotation": {"quaternions": [[1.0, 0, 0, 0]], "ephemeris_times": [self.centre_time]},
        }

    def seen(self, height: float, ahead: float = 0.0) -> NDArray[np.float64]:
        """Map X, Y (lines, columns, 2) at an ellipsoidal height of what each pixel sees, ray by ray.

        `ahead`: millimetres in the focal plane by which the line of detectors looks forward; such a line has no lens.
        """
        span = self.lines * self.line_time
        S, R = self.pose(-span / 2 + self.line_time * np.arange(self.lines))
        y = (np.arange(self.columns) + 0.5 - self.columns / 2) * self.pitch
        y = y if ahead else y * (1 - 2e-5 * y**2)
        d = np.stack([np.full_like(y, ahead), y, np.full_like(y, self.focal)], axis=-1)
        d = np.einsum("nij,cj->nci", R, d / np.linalg.norm(d, axis=1, keepdims=True))
        back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
        r = np.full(d.shape[:2], self.flying - height)
        for _ in range(8):
            lon, lat, h = back.transform(*np.moveaxis(S[:, None] + r[..., None] * d, -1, 0))
            r = r + (h - height)
        X, Y = Transformer.from_crs("EPSG:4979", self.crs, always_xy=True).transform(lon, lat, h)[:2]
        return np.stack([X, Y], axis=-1)

    def strip_file(self, folder: Path, lever: tuple[float, float, float] = (0.0, 0.0, 0.0), late: float = 0.0) -> Path:
        """The same flight as an aerial strip: a record of 200 Hz in the map, of an antenna, by a late clock."""
        span = self.lines * self.line_time
        t = np.arange(-0.6 * span, 0.6 * span, 0.005)
        S, R = self.pose(t)
        rest = R @ np.diag([1.0, -1.0, -1.0])  # camera axes with z up
        antenna = S - rest @ np.array(lever)
        back = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
        lon, lat, h = back.transform(*antenna.T)
        X, Y = Transformer.from_crs("EPSG:4979", self.crs, always_xy=True).transform(lon, lat, h)[:2]
        # Grid north is turned against true north by the convergence of the map.
        turn = _convergence(self.crs, lon, lat)
        omega, phi, kappa = _angles(_true_axes(lon, lat), rest, turn)
        table = np.column_stack([t + 500 + late, X, Y, h, omega, phi, kappa])
        np.savetxt(folder / "flight.csv", table, "%.10f", ",", header="time,x,y,z,omega,phi,kappa", comments="")
        half = (self.columns - 1) / 2
        path = folder / "strip.toml"
        path.write_text(
            f'format = "photoplan strip 1"\nlines = {self.lines}\n[clock]\nfirst = {500 - span / 2}\n'
            f'line = {self.line_time}\n[flight]\nfile = "flight.csv"\ncrs = "{self.crs}"\n'
            f'height_system = "ellipsoidal"\nlever_arm = {list(lever)}\ntime_offset = {-late}\n'
            f"[detectors.nadir]\ncolumns = {self.columns}\nfocal_mm = {self.focal}\n"
            f"y_mm = {_polynomial(half, self.pitch)}\n"
            f"[detectors.forward]\ncolumns = {self.columns}\nfocal_mm = {self.focal}\nx_mm = [46.6]\n"
            f"y_mm = [{half * self.pitch}, {-self.pitch}]\n"
        )
        return path

    def write(self, folder: Path, height: float) -> Path:
        """Image, ISD and project of a level ground; the project's path."""
        values = pattern(self.seen(height))
        profile = {"driver": "GTiff", "width": self.columns, "height": self.lines, "count": 1, "dtype": "float32"}
        with rasterio.open(folder / "strip.tif", "w", **profile) as file:
            file.write(values.astype(np.float32), 1)
        (folder / "strip.json").write_text(json.dumps(self.isd()))
        project = folder / "project.toml"
        project.write_text(
            f'format = 1\ncrs = "{self.crs}"\n[terrain]\nheight = {height}\nheight_system = "ellipsoidal"\n'
            '[[images]]\nname = "strip"\nfile = "strip.tif"\nline = "strip.json"\n'
        )
        return project


def pattern(XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grey values (...) of map points (..., 2): smooth, so that resampling tells positions, not sharpness."""
    X, Y = XY[..., 0] - 600_000.0, XY[..., 1] - 5_340_000.0
    return 100 + 40 * np.sin(X / 4.0) + 40 * np.cos(Y / 5.0)


def _about(axis: int, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    s, c = np.sin(angle), np.cos(angle)
    R = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[:, axis, axis], R[:, i, i], R[:, j, j], R[:, i, j], R[:, j, i] = 1.0, c, c, -s, s
    return R


def _quaternion(R: NDArray[np.float64]) -> list[float]:
    """Scalar first, from the eigenvector of Bar-Itzhack's matrix."""
    K = np.array(
        [
            [np.trace(R), R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0, 2 * R[0, 0] - np.trace(R), R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0, 0, 2 * R[1, 1] - np.trace(R), R[1, 2] + R[2, 1]],
            [0, 0, 0, 2 * R[2, 2] - np.trace(R)],
        ]
    )
    return [float(v) for v in np.linalg.eigh((K + np.triu(K, 1).T) / 3)[1][:, -1]]


def _true_axes(lon: NDArray[np.float64], lat: NDArray[np.float64]) -> NDArray[np.float64]:
    """East, north, up (columns) in the axes of the earth, (n, 3, 3)."""
    s, c, sl, cl = np.sin(np.radians(lon)), np.cos(np.radians(lon)), np.sin(np.radians(lat)), np.cos(np.radians(lat))
    zero = np.zeros_like(s)
    return np.stack(
        [np.stack([-s, c, zero], -1), np.stack([-sl * c, -sl * s, cl], -1), np.stack([cl * c, cl * s, sl], -1)], -1
    )


def _convergence(crs: str, lon: NDArray[np.float64], lat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle from true north to grid north, clockwise, radians (PROJ's own figure)."""
    return np.radians(Proj(crs).get_factors(lon, lat).meridian_convergence)


def _angles(
    axes: NDArray[np.float64], camera: NDArray[np.float64], turn: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """ω, φ, κ in degrees of camera axes against grid axes: R = Rx(ω) Ry(φ) Rz(κ)."""
    c, s, zero = np.cos(turn), np.sin(turn), np.zeros_like(turn)
    to_grid = np.stack(
        [np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, zero + 1], -1)], 1
    )
    R = to_grid @ np.swapaxes(axes, 1, 2) @ camera
    angles = np.arctan2(-R[:, 1, 2], R[:, 2, 2]), np.arcsin(R[:, 0, 2]), np.arctan2(-R[:, 0, 1], R[:, 0, 0])
    return tuple(np.degrees(each) for each in angles)  # type: ignore[return-value]


def _polynomial(half: float, pitch: float) -> list[float]:
    """Coefficients of y − 2e-5 y³, y = (half − column) · pitch: the lens of the ISD, columns to the right."""
    y = np.polynomial.Polynomial([half * pitch, -pitch])
    return [float(v) for v in (y - 2e-5 * y**3).coef]
