"""Projects of the real blocks, as `photoplan init` makes them."""

from __future__ import annotations

from pathlib import Path

from photoplan.products.init import InitRequest, init_project

__all__ = ["dmc_project", "drone_project"]


def drone_project(block: Path, folder: Path, *images: str) -> Path:
    """Project file in a folder, of images of the drone block by name; of all 18 if none is named."""
    chosen = images or ("*",)
    request = InitRequest(
        folder=folder,
        images=tuple(str(block / "images" / f"{name}.jpg") for name in chosen),
        camera=block / "int.yaml",
        orientation=block / "ext.csv",
        terrain=str(block / "dsm.tif"),
        height_system="same",
    )
    return init_project(request).path


def dmc_project(shared: Path, folder: Path) -> Path:
    """Project file in a folder, of the four DMC frames."""
    data = shared / "data" / "ngi_dmc"
    request = InitRequest(
        folder=folder,
        images=(str(data / "images" / "*.tif"),),
        camera=data / "eo" / "ngi_int_param.yaml",
        orientation=data / "eo" / "ngi_xyz_opk.csv",
        terrain=str(data / "dem.tif"),
        height_system="same",
    )
    return init_project(request).path
