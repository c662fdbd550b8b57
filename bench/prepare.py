"""Sources of the comparison: one real aerial frame, enlarged, with its camera in every form the programs read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
import yaml
from rpc import rasterio_rpc

from photoplan.cameras.rpc import fit_rpc
from photoplan.geometry.local import GeodeticGround
from photoplan.io.project.file import load_project
from photoplan.products.init import InitRequest, init_project
from photoplan.project.scene import open_scene

CHECKOUT = Path(__file__).resolve().parents[1]
WORK = CHECKOUT / "bench" / "_work"
DATA = CHECKOUT.parent / "shared" / "data" / "ngi_dmc"
FRAME = "3324c_2015_1004_05_0182_RGB"


@dataclass(frozen=True)
class Source:
    """One enlarged frame and all that belongs to it."""

    factor: int
    resolution: float
    """Ground pixel of the products, metres: 6 m divided by the factor, as the frame's own."""

    @property
    def folder(self) -> Path:
        return WORK / f"x{self.factor}"

    @property
    def image(self) -> Path:
        return self.folder / f"{FRAME}.tif"

    @property
    def image_with_rpc(self) -> Path:
        return self.folder / "rpc" / f"{FRAME}.tif"

    @property
    def camera(self) -> Path:
        return self.folder / "camera.yaml"

    @property
    def project(self) -> Path:
        return self.folder / "project" / "project.toml"

    @property
    def rpc_residual(self) -> Path:
        return self.folder / "rpc_residual_px.txt"

    @property
    def orientation(self) -> Path:
        return DATA / "eo" / "ngi_xyz_opk.csv"

    @property
    def crs(self) -> Path:
        return DATA / "eo" / "ngi_xyz_opk.prj"

    @property
    def terrain(self) -> Path:
        return DATA / "dem.tif"


SMALL = Source(6, 1.0)
LARGE = Source(12, 0.5)


def prepare(source: Source) -> None:
    """Write whatever of a source is missing."""
    source.image_with_rpc.parent.mkdir(parents=True, exist_ok=True)
    if not source.image.exists():
        _write(source.image, _enlarged(source.factor))
    _write_camera(source)
    # The project is written anew each time: its form may have changed since.
    init_project(
        InitRequest(
            folder=source.project.parent,
            images=(str(source.image),),
            camera=source.camera,
            orientation=source.orientation,
            terrain=str(source.terrain),
            height_system="same",
            overwrite=True,
        )
    )
    if not source.image_with_rpc.exists() or not source.rpc_residual.exists():
        _write_rpc(source)


def _enlarged(factor: int) -> np.ndarray:
    with rasterio.open(DATA / "images" / f"{FRAME}.tif") as data:
        pixels = data.read().transpose(1, 2, 0)
    return cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC).transpose(2, 0, 1)


def _write(file: Path, bands: np.ndarray, **tags: object) -> None:
    """Uncompressed, tiled, pixel-interleaved."""
    half = file.with_suffix(".part.tif")
    count, height, width = bands.shape
    form = {"tiled": True, "blockxsize": 512, "blockysize": 512, "interleave": "pixel"}
    with rasterio.open(
        half, "w", driver="GTiff", width=width, height=height, count=count, dtype=bands.dtype, **form, **tags
    ) as data:
        data.write(bands)
    half.replace(file)


def _write_camera(source: Source) -> None:
    cameras = yaml.safe_load((DATA / "eo" / "ngi_int_param.yaml").read_text())
    for camera in cameras.values():
        camera["im_size"] = [n * source.factor for n in camera["im_size"]]
    source.camera.write_text(yaml.safe_dump(cameras, sort_keys=False))


def _write_rpc(source: Source) -> None:
    with rasterio.open(source.terrain) as data:
        heights = data.read(1)
    scene_project = load_project(source.project)
    camera = open_scene(scene_project, FRAME).camera
    # Heights stay what they are: camera and terrain are in one system.
    ground = GeodeticGround(scene_project.crs, "same")
    fitted = fit_rpc(camera, ground, (float(np.nanmin(heights)), float(np.nanmax(heights))))
    with rasterio.open(source.image) as data:
        _write(source.image_with_rpc, data.read(), rpcs=rasterio_rpc(fitted.functions))
    source.rpc_residual.write_text(f"{fitted.worst:.6f}\n")
