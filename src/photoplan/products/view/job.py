"""A tile of a view: what its pixels show, and its colours."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.engine.run import Made, Output, Tally
from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.fingerprint import fingerprint
from photoplan.io.matrix_file import MatrixFile
from photoplan.plan.tiles import Tile
from photoplan.products.view.camera import CameraRequest, view_camera
from photoplan.products.view.content import Colours, ContentRequest, Resampled, ViewLayer, ViewScene, open_layers
from photoplan.products.view.ground import ViewGround, open_view_ground
from photoplan.products.view.overlay import Overlay
from photoplan.products.view.photo import PhotoRequest, ViewPhoto
from photoplan.products.view.stereo import anaglyph
from photoplan.surfaces.seen import Seen, SeenSurface, ground_size
from photoplan.targets.view import Bundle, ViewTarget
from photoplan.terrain.options import Lighting
from photoplan.terrain.shading import directions

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class LookRequest:
    """How a view looks."""

    contents: tuple[ContentRequest, ...] = (ContentRequest("tint"), ContentRequest("shade", "", 0.8))
    azimuth: float = 315.0
    """Of the sun, degrees clockwise from grid north."""
    altitude: float = 45.0
    """Of the sun above the horizon, degrees."""
    shadows: bool = False
    """Whether terrain and objects cast shadows."""
    haze: float = 0.0
    """Coefficient α of eq. 5.8 of Ecker 1991, per kilometre."""
    haze_colour: Colour = (200, 210, 222)
    """The brightness of the horizon in that equation."""
    sky: Colour = (186, 212, 238)
    nodata: Colour = (214, 214, 214)
    """Ground that no content shows."""
    water_colour: Colour = (112, 150, 184)
    """Water on which no raster or photo shows anything."""
    samples: int = 2
    """Rays along each side of a pixel, of which its colour is the mean."""
    kernel: str = "bicubic"
    tolerance: float = 0.02
    """Largest error of places in rasters and photos, pixels of them; 0: every pixel is computed strictly."""
    photo: PhotoRequest | None = None
    """A photograph that the picture is compared with."""

    def __post_init__(self) -> None:
        if not 0 <= self.haze <= 100:
            raise UsageError(f"`haze` {self.haze} per kilometre; 0 to 100 are allowed, 0.1 is much")
        if not 1 <= self.samples <= 8:
            raise UsageError(f"`samples` {self.samples}; 1 to 8 rays along each side of a pixel are allowed")
        if not (self.tolerance == 0 or 1e-6 <= self.tolerance <= 10):
            raise UsageError(
                f"`tolerance` {self.tolerance} px; it must be 0 (every pixel strictly) or 1e-6 to 10 (usual is 0.02)"
            )
        for name in ("haze_colour", "sky", "nodata", "water_colour"):
            if not all(0 <= v <= 255 for v in getattr(self, name)):
                raise UsageError(f"`{name}` {getattr(self, name)}; red, green and blue from 0 to 255 are needed")
        Lighting(azimuth=self.azimuth, altitude=self.altitude)


@dataclass(frozen=True)
class ViewAddress:
    """All that a worker needs to make tiles of a view: small, hashable, pickles."""

    source: str
    """Project or terrain model."""
    crs: str | None
    water: float | None
    camera: CameraRequest
    look: LookRequest
    heights: tuple[float, float]
    """Of what is seen, for tints."""
    farthest: float
    bound: float
    matrix: str | None
    digests: tuple[tuple[str, str], ...]
    """Path and content digest of each input file."""

    def open(self) -> OpenView:
        """The view; kept for the next tile."""
        return _open(self)


@dataclass(frozen=True, eq=False)
class OpenView:
    """A view, ready to be made."""

    target: ViewTarget
    surface: SeenSurface
    layers: tuple[ViewLayer, ...]
    light: Lighting
    matrix: MatrixFile | None
    photo: ViewPhoto | None
    water: float | None
    """Height of water, metres."""

    @property
    def shift(self) -> int:
        """Columns by which a photo lies beside the picture."""
        return 0 if self.photo is None else self.photo.shift


@lru_cache(maxsize=4)
def _open(address: ViewAddress) -> OpenView:
    for path, digest in address.digests:
        if fingerprint(path).digest != digest:
            raise InputError(f"{path}: has changed since the run was planned; run it again")
    ground = open_view_ground(Path(address.source), address.crs, address.water)
    camera = view_camera(address.camera, ground, force=True)
    light = Lighting(
        azimuth=address.look.azimuth, altitude=address.look.altitude, exaggeration=camera.request.exaggeration
    )
    layers = open_layers(address.look.contents, ground, light, address.heights)
    matrix = None if address.matrix is None else MatrixFile(Path(address.matrix))
    photo = None if address.look.photo is None else ViewPhoto.open(address.look.photo, camera.target.bundle.size)
    surface = seen_surface(ground, address.farthest, address.bound)
    return OpenView(
        target=camera.target,
        surface=surface,
        layers=layers,
        light=light,
        matrix=matrix,
        photo=photo,
        water=ground.water,
    )


def seen_surface(ground: ViewGround, farthest: float, bound: float) -> SeenSurface:
    """The ground as the surface of views."""
    return SeenSurface(ground.terrain, ground.bounds, farthest, bound)


@dataclass(frozen=True, eq=False)
class _Finer:
    """A bundle with n × n pixels for each."""

    bundle: Bundle
    n: int
    size: tuple[int, int] = field(init=False)
    center: NDArray[np.float64] = field(init=False)
    upright: bool = field(init=False)

    def __post_init__(self) -> None:
        width, height = self.bundle.size
        object.__setattr__(self, "size", (width * self.n, height * self.n))
        object.__setattr__(self, "center", self.bundle.center)
        object.__setattr__(self, "upright", self.bundle.upright)

    def directions(self, uv: ArrayLike) -> NDArray[np.float64]:
        return self.bundle.directions((np.asarray(uv, float) + 0.5) / self.n - 0.5)

    def pixels(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        out = self.bundle.pixels(XYZ)
        out[..., :2] = (out[..., :2] + 0.5) * self.n - 0.5
        return out


@dataclass(frozen=True)
class ViewJob:
    """What a worker is told once of a view."""

    address: ViewAddress
    matrix: bool = False
    """Whether tiles are those of the coordinate matrix, or of the picture."""
    overlay: Overlay | None = None
    """What is drawn over the picture."""
    right: ViewJob | None = None
    """The right picture of a stereo pair, of which this is the left one."""
    beside: bool = False
    """Whether the right picture lies beside this one, or both make an anaglyph."""

    def __call__(self, tile: Tile) -> Made:
        """Colours or ground of a tile, and counts of its pixels."""
        if self.right is not None:
            return self._pair(tile, self.right)
        view = self.address.open()
        if self.matrix:
            seen = view.surface.look(view.target, tile.window)
            return Made((matrix_bands(view.target, seen),), _counts(view.target, seen))
        picture, tally = np.zeros((3, tile.window.height, tile.window.width), np.uint8), Tally()
        own = tile.window & view.target.window
        if own.size:
            self._paint(view, Tile(tile.index, own), picture[:, *own.slices(tile.window)], tally)
        if view.photo is not None:
            view.photo.lay(picture, tile.window)
        if self.overlay is not None:
            for shift in dict.fromkeys((0, view.shift)):
                self.overlay.paint(picture, tile.window, shift)
        return Made(((picture, None),), tally.totals)

    def _pair(self, tile: Tile, right: ViewJob) -> Made:
        """A tile of both pictures of a pair; rays of both are counted."""
        shift = self.address.open().target.window.width if self.beside else 0
        window = tile.window
        moved = Tile(tile.index, Window(window.col - shift, window.row, window.width, window.height))
        one, other = replace(self, right=None)(tile), right(moved)
        tally = Tally()
        tally.add(one.record)
        tally.add(other.record)
        assert one.layers[0] is not None and other.layers[0] is not None
        pictures = one.layers[0][0], other.layers[0][0]
        return Made(((np.maximum(*pictures) if self.beside else anaglyph(*pictures), None),), tally.totals)

    def _paint(self, view: OpenView, tile: Tile, picture: NDArray[np.uint8], tally: Tally) -> None:
        """Colours of a part of the view."""
        n, window = (1 if view.matrix else self.address.look.samples), tile.window
        target = view.target if n == 1 else replace(view.target, bundle=_Finer(view.target.bundle, n))
        for part in window.tiles(-(-max(window.width, window.height) // n)):
            fine = Window(part.col * n, part.row * n, part.width * n, part.height * n)
            look = partial(view.surface.look, target) if view.matrix is None else partial(from_matrix, view)
            scene = ViewScene.of(
                target,
                Tile(tile.index, fine),
                look,
                view.surface,
                self.address.look.kernel,
                self.address.look.tolerance,
            )
            colours = colours_of(scene, view, self.address.look)
            samples = colours.reshape(3, part.height, n, part.width, n)
            if any(isinstance(layer, Resampled) and layer.classes for layer in view.layers):
                # Pixels on the border of two classes belong to one of them.
                means = samples[:, :, n // 2, :, n // 2]
            else:
                means = samples.mean(axis=(2, 4))
            at = part.slices(window)
            picture[:, at[0], at[1]] = np.clip(np.rint(means), 0, 255)
            tally.add(_counts(target, scene.seen))


def colours_of(scene: ViewScene, view: OpenView, look: LookRequest) -> Colours:
    """Colours of a part of a view: contents one over the other, shadows, haze, sky."""
    seen = scene.seen
    out = np.empty((3, *seen.owner.shape), np.float32)
    out[:] = np.array(look.nodata, np.float32)[:, None, None]
    water = (seen.owner == 0) & (seen.XYZ[..., 2] == view.water)
    out = np.where(water, np.array(look.water_colour, np.float32)[:, None, None], out)
    for k, (request, layer) in enumerate(zip(look.contents, view.layers)):
        over, there = layer.paint(scene, out)
        if request.kind in ("shade", "tint", "slope"):
            there = there & ~water
        opacity = np.float32(1.0 if request.kind == "shade" and k else request.opacity)
        out = np.where(there, out + opacity * (over - out), out)
    if look.shadows:
        dark = scene.surface.in_shadow(scene.target, seen, directions(view.light)[0])
        out = np.where(dark, out * 0.45, out)
    if look.haze:
        out = hazy(out, scene.target.distance(seen.uvh), look.haze, look.haze_colour)
    sky = np.array(look.sky, np.float32)[:, None, None]
    return np.where(seen.owner >= 0, out, sky).astype(np.float32)


def hazy(colours: Colours, distance: NDArray[np.float64], alpha: float, horizon: Colour) -> Colours:
    """Colours at a distance, metres, through haze (Ecker 1991, eq. 5.8, after Kuhn 1989); α per kilometre."""
    left = np.exp(-alpha * np.nan_to_num(distance) / 1000).astype(np.float32)
    return np.asarray(colours * left + np.array(horizon, np.float32)[:, None, None] * (1 - left))


def matrix_bands(target: ViewTarget, seen: Seen) -> Output | None:
    """Bands of `io.matrix_file`, float64, and where there is ground; None: only sky."""
    there = seen.owner >= 0
    if not there.any():
        return None
    bands = np.stack(
        [
            *np.moveaxis(seen.XYZ, -1, 0),
            target.distance(seen.uvh),
            np.degrees(seen.incidence),
            ground_size(target, seen),
            seen.owner,
            *np.moveaxis(seen.normal[..., :2], -1, 0),
        ]
    )
    bands[4:, there] = np.nan_to_num(bands[4:, there])
    return bands, there


def from_matrix(view: OpenView, window: Window) -> Seen:
    """What pixels show, as a coordinate matrix has it."""
    assert view.matrix is not None
    bands = view.matrix.read(window)
    XYZ = np.moveaxis(bands[:3], 0, -1)
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    uvh = np.stack([u, v, view.target.to_view(XYZ)[..., 2]], axis=-1)
    level = np.moveaxis(bands[7:9], 0, -1)
    up = np.sqrt(np.clip(1 - (level**2).sum(axis=-1), 0, None))
    way = view.target.center - XYZ
    there = np.isfinite(XYZ[..., 2])
    with np.errstate(invalid="ignore"):
        towards = way / np.linalg.norm(way, axis=-1, keepdims=True)
    return Seen(
        XYZ=XYZ,
        uvh=uvh,
        normal=np.concatenate([level, up[..., None]], axis=-1),
        towards=towards,
        owner=np.where(there, np.nan_to_num(bands[6]), -1).astype(np.int64),
        lost=~there & (view.target.bundle.directions(uvh[..., :2])[..., 2] < 0),
    )


def _counts(target: ViewTarget, seen: Seen) -> dict[str, Any]:
    """Figures of a tile, to be added up."""
    there = seen.owner >= 0
    figures: dict[str, Any] = {"pixels": there.size, "ground": int(there.sum()), "lost": int(seen.lost.sum())}
    if there.any():
        away = target.distance(seen.uvh[there])
        figures |= {"worst_distance": float(away.max()), "worst_nearness": -float(away.min())}
    return figures
