"""Perspective views: jobs, stereo pairs, pictures, results."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan import __version__
from photoplan.engine.executors import Workers
from photoplan.engine.run import Made, Output, Tally, Work
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.grid import Placement, Window
from photoplan.geometry.pose import dot
from photoplan.io.disk import PICTURES, make_folder
from photoplan.io.files import fingerprint
from photoplan.io.product import DESCRIPTION, ProductFile, check_output
from photoplan.io.quality_files import BANDS, MatrixFile
from photoplan.io.raster_info import ImageForm
from photoplan.io.store import input_entry, run_key, scratch, together, write_atomically, write_run_record
from photoplan.plain import json_text, pick, plain
from photoplan.plan.footprint import Tile, Tiles
from photoplan.products.run import Run, refuse_inputs
from photoplan.products.view.camera import ViewCamera, ViewGround, map_axes, open_view_ground, view_camera
from photoplan.products.view.content import (
    Colours,
    Overlay,
    OverlayFacts,
    Resampled,
    ViewLayer,
    ViewScene,
    open_layers,
    overlay,
)
from photoplan.products.view.lines import open_drawing
from photoplan.products.view.photo import ViewPhoto
from photoplan.requests.view import (
    USUAL_REFRACTION,
    CameraRequest,
    Colour,
    ContentRequest,
    LookRequest,
    MatrixRequest,
    PhotoRequest,
    SightRequest,
    Stereo,
    ViewRequest,
)
from photoplan.surfaces.seen import LinesOfSight, Seen, SeenSurface, ground_size
from photoplan.targets.view import Bundle, FrameBundle, ViewTarget
from photoplan.terrain.shading import Lighting, directions

_LUMINANCE = (0.299, 0.587, 0.114)


def eyes(camera: ViewCamera, base: float) -> tuple[CameraRequest, CameraRequest]:
    """The left and the right camera: moved by half the base along the rows of the picture, axes parallel."""
    request, target = camera.request, camera.target
    if not isinstance(target.bundle, FrameBundle):
        raise UsageError("a stereo pair needs a plane picture; panoramas have one place only")
    if request.image is not None:
        return request.replace(aside=-base / 2), request.replace(aside=base / 2)
    assert request.position is not None and request.altitude is not None
    right = map_axes(target.warps, target.center).T @ target.bundle.camera.pose.R_ground_camera[:, 0]
    at = np.array([*request.position, request.altitude])
    left, other = (at + side * base / 2 * right for side in (-1.0, 1.0))
    return _moved(request, left), _moved(request, other)


def _moved(request: CameraRequest, at: NDArray[np.float64]) -> CameraRequest:
    x, y, z = at.tolist()
    return request.replace(position=(x, y), altitude=z)


def anaglyph(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Two pictures (3, height, width) for red and cyan glasses: the brightness of the left one, green and blue of the
    right one."""
    out = right.copy()
    out[0] = np.rint(
        dot(np.moveaxis(left, 0, -1).astype(np.float64), np.broadcast_to(_LUMINANCE, (*left.shape[1:], 3)))
    )
    return out


@dataclass(frozen=True)
class ViewAddress:
    """All that a worker needs to make tiles of a view: small, hashable, pickles."""

    source: str
    """Project or terrain model."""
    crs: str | None
    water: float | None
    camera: CameraRequest
    look: LookRequest
    photo: PhotoRequest | None
    heights: tuple[float, float]
    """Heights of what is seen, for tints."""
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
    light = address.look.light(camera.request.exaggeration)
    layers = open_layers(address.look.contents, ground, light, address.heights)
    matrix = None if address.matrix is None else MatrixFile(Path(address.matrix))
    photo = None if address.photo is None else ViewPhoto.open(address.photo, camera.target.bundle.size)
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
    """Job of a worker."""

    address: ViewAddress
    matrix: bool = False
    """True if tiles are those of the coordinate matrix, not of the picture."""
    overlay: Overlay | None = None
    """Lines and labels over the picture."""
    right: ViewJob | None = None
    """The right picture of a stereo pair, of which this is the left one."""
    beside: bool = False
    """True if the right picture lies next to this one, False if both make an anaglyph."""

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
    """Return what pixels show, as a coordinate matrix has it."""
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


@dataclass(frozen=True)
class ViewResult:
    """File and counts of a picture or matrix."""

    path: Path
    size: tuple[int, int]
    tiles: int
    sky: int
    """Pixels that show no ground (of a picture with several rays to a pixel: rays)."""
    rays: int
    lost: int
    """Sky pixels whose rays point downwards: they pass the border of the terrain, or a hole of it."""
    nearest: float | None
    farthest: float | None
    """Distances of ground, metres."""
    resumed: int
    """Tiles of an earlier run."""
    seconds: float
    svg: Path | None = None
    drawn: OverlayFacts | None = None
    """Counts of lines and labels."""

    def json_fields(self) -> dict[str, Any]:
        """Counts of rays."""
        counts = pick(self, "rays", sky_rays="sky", downward_sky_rays="lost")
        return {**pick(self, "path", "size", "tiles", nearest_m="nearest", farthest_m="farthest"), **counts,
                **pick(self, "seconds", resumed_tiles="resumed"),
                **({} if self.drawn is None else pick(self, "svg", "drawn"))}  # fmt: skip


#: Rays along the longer side of a picture that are looked at before it is made.
_FIRST_LOOK = 64


@dataclass(frozen=True)
class FirstLook:
    """Estimate of a view from a few rays."""

    ground: float
    """Share of pixels that show ground, 0 to 1."""
    nearest: float | None
    farthest: float | None
    """Distances of ground, metres; None: there is none."""
    lowest: float | None
    highest: float | None
    """Heights of ground, metres."""
    pixel: float | None
    """Median size of a pixel on the ground, across the line of sight, metres."""


def first_look(target: ViewTarget, surface: SeenSurface) -> FirstLook:
    """Return what some rays over the whole picture meet."""
    width, height = target.bundle.size
    step = max(1.0, max(width, height) / _FIRST_LOOK)
    u, v = (np.arange((side % step) / 2 if side > step else 0.0, side, step) for side in (width, height))
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    seen = surface.at(target, uv)
    there = seen.owner >= 0
    if not there.any():
        return FirstLook(ground=0.0, nearest=None, farthest=None, lowest=None, highest=None, pixel=None)
    away, Z = target.distance(seen.uvh[there]), seen.XYZ[there, 2]
    beside = target.bundle.directions(uv[there] + (1.0, 0.0)) - target.bundle.directions(uv[there])
    pixel = np.median(np.abs(seen.uvh[there, 2]) * np.linalg.norm(beside, axis=1))
    return FirstLook(
        ground=float(there.mean()),
        nearest=float(away.min()),
        farthest=float(away.max()),
        lowest=float(Z.min()),
        highest=float(Z.max()),
        pixel=float(pixel),
    )


TILE = 512


@dataclass(frozen=True, eq=False)
class ViewPlan(Result):
    """A view before its pixels."""

    request: ViewRequest
    camera: ViewCamera
    first: FirstLook
    address: ViewAddress
    key: str

    @property
    def placement(self) -> Placement:
        """Size of what is written: wider than the picture if a photo lies next to it."""
        photo, (width, height) = self.address.photo, self.camera.target.bundle.size
        beside = (photo is not None and photo.how == "beside") or (self.stereo is not None and self.stereo.beside)
        return Placement((2 * width if beside else width, height))

    @property
    def tiles(self) -> Tiles:
        """Tiles of what is written."""
        return Tiles.every(self.placement.window, TILE)

    @property
    def stereo(self) -> Stereo | None:
        """The pair with its base in metres; None if there is one picture."""
        return None if self.request.pair is None else self.request.pair.stated(self.first.nearest)

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angles between the middles of opposite sides of the picture, degrees."""
        bundle = self.camera.target.bundle
        (w, h), panorama = bundle.size, self.camera.request.panorama is not None
        if panorama:
            return (self.camera.request.field_of_view or 360.0, math.nan)
        edges = np.array([(-0.5, (h - 1) / 2), (w - 0.5, (h - 1) / 2), ((w - 1) / 2, -0.5), ((w - 1) / 2, h - 0.5)])
        d = bundle.directions(edges)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        across, along = (float(np.degrees(np.arccos(np.clip(d[k] @ d[k + 1], -1, 1)))) for k in (0, 2))
        return across, along

    def written(self) -> Sequence[Path]:
        """Return no file: none is written."""
        return ()

    def summary(self) -> Sequence[str]:
        """Return the standpoint, the camera, and what a first look sees."""
        x, y, z = self.camera.target.center
        request, first = self.camera.request, self.first
        width, height = self.camera.target.bundle.size
        across, along = self.field_of_view
        what = f"azimuth {request.azimuth:.3f}°, pitch {request.pitch:.3f}°" if request.image is None else ""
        upright = f" × {along:.4g}" if along == along else ""
        earth = "flat earth"
        if request.image and self.camera.target.warps and self.camera.earth_radius is None:
            earth = "earth and refraction as the project has them"
        elif self.camera.earth_radius is not None:
            k = USUAL_REFRACTION if request.refraction is None else request.refraction
            earth = f"{request.curvature or 'bend'}: R = {self.camera.earth_radius / 1000:.0f} km, k = {k:g}"
        if request.exaggeration != 1:
            earth += f"; heights × {request.exaggeration:g} about {request.reference:.2f} m"
        if self.stereo is not None:
            earth += f"; {self.stereo.how}, base {self.stereo.base:g} m"
        ground = "no ground is seen"
        if first.nearest is not None:
            ground = (
                f"ground at {first.nearest:.4g} to {first.farthest:.4g} m, heights {first.lowest:.6g} to "
                f"{first.highest:.6g} m, pixel {first.pixel:.3g} m in the median, {1 - first.ground:.0%} sky"
            )
        return [
            f"standpoint {x:.2f} {y:.2f} {z:.2f}, {self.camera.above_ground:.2f} m above ground",
            f"{what or f'image {request.image}'}; field of view {across:.4g}{upright}°; {width} × {height} pixels; "
            f"{earth}",
            ground,
        ]

    def json_fields(self) -> dict[str, Any]:
        """Return what will be seen."""
        return {
            **self.camera.json_fields(),
            "size": list(self.camera.target.bundle.size),
            "tiles": len(self.tiles),
            "field_of_view_deg": list(self.field_of_view),
            "farthest_m": self.request.farthest,
            "error_bound_m": self.request.bound,
            **({} if self.request.water is None else {"water_m": self.request.water}),
            **({} if self.stereo is None else {"stereo": self.stereo.how, "base_m": self.stereo.base}),
            "expected": self.first,
        }


def plan_view(request: ViewRequest) -> ViewPlan:
    """Put the camera on the ground and look what it will see; nothing is written.

    Raises
    ------
    UsageError
        The output exists or is an input, or a choice makes no sense.
    InputError
        A file cannot be used.
    GeometryError
        The point of view lies below the ground, or sees none of it.
    """
    ground = open_view_ground(request.source, request.crs, request.water)
    camera = view_camera(camera_request(request, request.matrix), ground, request.force)
    _check_driver(request)
    surface = seen_surface(ground, request.farthest, request.bound)
    first = first_look(camera.target, surface)
    if first.ground == 0 and not request.force:
        raise GeometryError(_sees_nothing(camera, ground))
    heights = (0.0, 1.0) if first.lowest is None or first.highest is None else _rounded(first.lowest, first.highest)
    contents = () if request.kind == "matrix" else request.look.contents
    if contents and ground.project is not None and "contents" not in request.look.model_fields_set:
        contents = (ContentRequest("photos"),)
    layers = open_layers(contents, ground, request.look.light(camera.request.exaggeration), heights)
    matrix = None if request.matrix is None else _fitting(request.matrix, camera)
    files = dict.fromkeys([*ground.files, *(f for each in layers for f in each.files)])
    photo = None if request.photo is None else ViewPhoto.open(request.photo, camera.target.bundle.size)
    files |= {each: None for each in (matrix, None if photo is None else photo.reader.path) if each is not None}
    files |= {each.path: None for each in request.lines if each.path is not None}
    inputs = [input_entry(path) for path in files]
    address = ViewAddress(
        source=str(request.source.resolve()),
        crs=request.crs,
        water=request.water,
        camera=camera.request,
        look=request.look.replace(contents=contents),
        photo=request.photo,
        heights=heights,
        farthest=request.farthest,
        bound=request.bound,
        matrix=None if matrix is None else str(matrix.resolve()),
        digests=tuple((str(Path(each["path"]).resolve()), each["sampled_sha256"]) for each in inputs),
    )
    told: list[Any] = [camera.request, _look_facts(address), heights, request.farthest, request.bound, TILE]
    if request.water is not None:
        told.append(("water", request.water))
    if request.lines:
        drawn = [(each.layer, each.interval, each.options) for each in request.lines]
        told += [drawn, request.text_size, request.lettering is not None]
    if request.pair is not None:
        pair = request.pair.stated(first.nearest)
        told += [pair, eyes(camera, pair.metres)]
    return ViewPlan(
        request=request, camera=camera, first=first, address=address, key=run_key(f"view {request.kind}", told, inputs)
    )


def camera_request(request: SightRequest, matrix: Path | None = None) -> CameraRequest:
    """Return the camera that is stated, or that of the matrix."""
    camera = None if request.camera is None else request.camera.read()
    if camera is None and matrix is not None:
        return CameraRequest.from_dict(_stated_camera(MatrixFile(matrix)), str(matrix))
    if camera is None or (camera.image is None and camera.position is None):
        raise UsageError("a view needs one `camera`: an image of the project, or a standpoint `position` X Y")
    return camera


def _stated_camera(file: MatrixFile) -> dict[str, Any]:
    """Return the camera that a matrix states."""
    try:
        return dict(json.loads(file.description)["camera"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file.info.path}: does not say which view it is of; make it again") from error


def _fitting(path: Path, camera: ViewCamera) -> Path:
    """A matrix, if it is of this view."""
    file = MatrixFile(path)
    stated = _stated_camera(file)
    if file.info.size != camera.target.bundle.size or stated != plain(camera.json_fields()["camera"]):
        raise InputError(f"{path}: is of another view; leave out the camera to take that of the matrix")
    return path


def _look_facts(address: ViewAddress) -> dict[str, Any]:
    """Return what decides colours: of files the content counts, which is among the inputs."""
    contents = [
        (each.kind, "" if each.kind == "raster" else each.value, each.opacity, each.classes)
        for each in address.look.contents
    ]
    photo = address.photo and (address.photo.how, address.photo.opacity)
    return {**address.look.json_fields(), "contents": contents, "photo": photo}


def _check_driver(request: ViewRequest) -> None:
    if request.output is None:
        return
    suffix = request.output.suffix.lower()
    allowed = (".tif", ".tiff") if request.kind == "matrix" else (*PICTURES, ".tif", ".tiff")
    if suffix not in allowed:
        raise UsageError(f"{request.output}: a {request.kind} is written as {', '.join(allowed)}")


def _rounded(low: float, high: float) -> tuple[float, float]:
    """Heights of a ramp, rounded outwards to a tenth of their range."""
    step = 10 ** math.floor(math.log10(max(high - low, 1.0)))
    return math.floor(low / step) * step, math.ceil(high / step + 1e-9) * step


def _sees_nothing(camera: ViewCamera, ground: ViewGround) -> str:
    x, y, z = camera.target.center
    b = ground.bounds
    covered = "everywhere" if b is None else f"{b[0]:.0f} {b[1]:.0f} {b[2]:.0f} {b[3]:.0f}"
    return (
        f"from {x:.2f} {y:.2f} {z:.2f} no ground is seen; the terrain is {covered}. Check position, height and "
        "direction (or say `force` for a picture of the sky)"
    )


@dataclass(frozen=True, eq=False)
class ViewReport(Result):
    """A view that was made."""

    plan: ViewPlan
    made: ViewResult

    def json_fields(self) -> dict[str, Any]:
        """Return counts of rays, and the view."""
        return {**self.made.json_fields(), "view": self.plan}

    def written(self) -> Sequence[Path]:
        """Return the picture, and the layer of what is drawn."""
        return [path for path in (self.made.path, self.made.svg) if path is not None]

    def messages(self) -> Sequence[str]:
        """Return what is drawn, and how much is sky."""
        made, lines = self.made, []
        if (d := made.drawn) is not None:
            room = f", no room for {d.unplaced}" if d.unplaced else ""
            lines.append(f"{d.seen} of {d.features} lines and points are seen; {d.labels} labels{room}")
        near = "" if made.nearest is None else f"; ground from {made.nearest:.4g} to {made.farthest:.6g} m"
        lost = made.lost / made.rays
        beyond = f" ({lost:.1%} downwards, past the terrain's border or through holes)" if lost else ""
        size = f"{made.size[0]} × {made.size[1]} pixels in {made.seconds:.1f} s"
        return [*lines, f"{size}, {made.sky / made.rays:.1%} sky{beyond}{near}"]


def view_picture(request: ViewRequest, events: Events = SILENT) -> ViewPlan | ViewReport:
    """Plan and make a picture; a run that was killed is continued by the same request. For errors see `make_view`."""
    if request.output is None and not request.dry_run:
        raise UsageError("no `output`; give the name of the picture, or `dry_run`")
    plan = plan_view(request)
    if request.dry_run:
        return plan
    for line in plan.summary():
        events.talk(line)
    return ViewReport(plan, make_view(plan, Run.of(request, events)))


def view_matrix(request: MatrixRequest, events: Events = SILENT) -> ViewPlan | ViewReport:
    """Plan and make the ground of every pixel of a view, a raster of nine bands. For errors see `make_view`."""
    return view_picture(request.part(ViewRequest, kind="matrix"), events)


def make_view(plan: ViewPlan, run: Run) -> ViewResult:
    """Make the picture or the matrix of a plan; a run that was killed is continued by the same request.

    Raises
    ------
    UsageError
        The output exists or is an input.
    RunLocked
        Another run is writing it.
    TilesFailed
        A tile failed again and again; nothing stays under the name then.
    ResourceError
        Disk or memory ran out.
    """
    run.check()
    inputs = (Path(each) for each, _ in plan.address.digests)
    with run.runner(inputs, _output(plan).parent) as runner, together():
        work = view_work(plan, run, runner.workers)
        run.events.begin(work.name, work.count)
        result: ViewResult
        (result,) = runner.run([work])
    return result


def _output(plan: ViewPlan) -> Path:
    assert plan.request.output is not None
    return plan.request.output


def view_work(plan: ViewPlan, run: Run, workers: Workers) -> Work[ViewResult]:
    """A picture or matrix as one of the products of a run; its output is checked, and its folder made."""
    path, request = _output(plan), plan.request
    outputs = [path] if request.svg is None else [path, request.svg]
    refuse_inputs([Path(each) for each, _ in plan.address.digests], outputs)
    for each in outputs:
        check_output(each, [name for name, _ in plan.address.digests], overwrite=run.overwrite)
        make_folder(each.parent)
    is_matrix, placement = request.kind == "matrix", plan.placement
    file = ProductFile(
        path,
        placement,
        len(BANDS) if is_matrix else 3,
        np.dtype(np.float64 if is_matrix else np.uint8),
        run_key=plan.key,
        nodata="auto" if is_matrix else "mask",
        overviews=False,
        tile=TILE,
        overwrite=run.overwrite,
        inputs=[each for each, _ in plan.address.digests],
        threads=run.workers,
        driver=PICTURES.get(path.suffix.lower(), "COG"),
        form=ImageForm(descriptions=tuple(n for n, _ in BANDS), units=tuple(u for _, u in BANDS))
        if is_matrix
        else None,
    )
    tiles, job = plan.tiles, _job(plan)
    return Work(
        name=path.stem,
        job=job,
        tiles=tiles,
        count=len(tiles),
        sinks=(file,),
        complete=partial(_complete, plan, job.overlay, file, run.clock(workers)),
        scratch=partial(scratch, path.parent),
    )


def _job(plan: ViewPlan) -> ViewJob:
    """Return the job of workers; that of a pair makes both pictures."""
    if plan.stereo is None:
        return ViewJob(plan.address, plan.request.kind == "matrix", draw(plan, plan.camera))
    ground = open_view_ground(plan.request.source, plan.request.crs, plan.request.water)
    left, right = (
        ViewJob(replace(plan.address, camera=eye), overlay=draw(plan, view_camera(eye, ground, force=True)))
        for eye in eyes(plan.camera, plan.stereo.metres)
    )
    return replace(left, right=right, beside=plan.stereo.beside)


def draw(plan: ViewPlan, camera: ViewCamera) -> Overlay | None:
    """Return what is drawn over the picture of a camera; None for nothing."""
    request = plan.request
    if not request.lines:
        return None
    ground = open_view_ground(request.source, request.crs, request.water)
    reach = min(request.farthest, 1.5 * (plan.first.farthest or 0.0) + 1000.0)
    drawing = open_drawing(request.lines, ground, reach, camera.target.center)
    sight = LinesOfSight(camera.target, seen_surface(ground, request.farthest, request.bound))
    return overlay(drawing, sight, request.lettering, request.text_size)


def _complete(
    plan: ViewPlan,
    drawn: Overlay | None,
    file: ProductFile,
    times: Callable[[], dict[str, Any]],
    tally: Tally,
) -> ViewResult:
    tally.check(file.path)
    facts = plan.json_fields()
    names = ("standpoint", "camera", "earth_radius", "bend_per_metre", "error_bound_m", "water_m", "stereo", "base_m")
    told = {name: facts[name] for name in names if name in facts}
    tags = {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_KEY": plan.key,
        DESCRIPTION: json_text(told, "view", indent=None),
    }
    made, svg = file.complete(tags), plan.request.svg
    if svg is not None and drawn is not None:
        fits = file.path.suffix.lower() in PICTURES and plan.placement.size == drawn.size
        below = file.path.name if fits and file.path.parent == svg.parent else None
        write_atomically(svg, drawn.svg(below).encode())
    ran, totals = times(), tally.totals
    result = ViewResult(
        path=file.path,
        size=plan.placement.size,
        tiles=len(plan.tiles),
        sky=totals["pixels"] - totals["ground"],
        rays=totals["pixels"],
        lost=totals["lost"],
        nearest=-totals["worst_nearness"] if "worst_nearness" in totals else None,
        farthest=totals.get("worst_distance"),
        resumed=tally.resumed,
        seconds=ran["seconds"],
        svg=svg,
        drawn=None if drawn is None else drawn.facts,
    )
    write_run_record(
        file.path,
        key=plan.key,
        inputs=[input_entry(path, digest) for path, digest in plan.address.digests],
        run=ran,
        kind=f"view {plan.request.kind}",
        product=result,
        settings={
            "look": {**plan.address.look.json_fields(), "photo": plan.address.photo},
            "farthest": plan.request.farthest,
        },
        view=plan,
        bytes=made.bytes,
    )
    return result
