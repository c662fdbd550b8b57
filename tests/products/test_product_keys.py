"""Keys of products: what moves a pixel changes them, nothing else does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tools.small_block import Block

from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.products.orthophoto.plan import plan_orthophotos


def key(project: Project, name: str = "one", **settings: Any) -> str:
    return plan_orthophotos(project, [name], **{"resolution": 1.0, "tile": 128, **settings}).products[0].key


def changed(project: Project, **tables: Any) -> Project:
    """The project with other entries; ``image`` is the first image's, ``camera`` that of all."""
    values = project.model_dump(mode="json", exclude_none=True)
    values["images"][0] |= tables.pop("image", {})
    for camera in values["cameras"].values():
        camera |= tables.get("camera", {})
    tables.pop("camera", None)
    for name, entries in tables.items():
        values[name] = {**values.get(name, {}), **entries} if isinstance(entries, dict) else entries
    return Project.model_validate({**values, "folder": project.folder})


@pytest.fixture(scope="module")
def project(pristine: Block) -> Project:
    return load_project(pristine.project)


@pytest.mark.parametrize(
    "tables",
    [
        {"observations": {"image_points": ["points.csv"], "sigma_image": 0.3}},
        {"adjustment": {"drift": "linear", "boresight": True}},
        {"image": {"sigma_center": [0.1, 0.1, 0.2], "sigma_angles": [0.001, 0.001, 0.001]}},
        {"ortho": {"kernel": "nearest"}},
    ],
    ids=lambda tables: next(iter(tables)),
)
def test_what_moves_no_pixel_keeps_the_key(project: Project, tables: dict[str, Any]) -> None:
    kernel = {"kernel": "bicubic"} if "ortho" in tables else {}
    assert key(changed(project, **tables), **kernel) == key(project)


def test_names_and_other_images_keep_the_key(project: Project) -> None:
    alone = project.model_copy(update={"images": project.images[:1]})
    assert key(alone) == key(project)
    assert key(changed(project, image={"name": "another"}), "another") == key(project)
    (name,) = {image.camera for image in project.images}
    images = tuple(image.model_copy(update={"camera": "new"}) for image in project.images)
    renamed = project.model_copy(update={"cameras": {"new": project.cameras[name]}, "images": images})
    assert key(renamed) == key(project)


def test_a_project_in_another_folder_keeps_the_key(project: Project, pristine: Block, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(pristine.folder, tmp_path / "copy")
    assert key(load_project(tmp_path / "copy" / pristine.project.name)) == key(project)


@pytest.mark.parametrize(
    "tables",
    [
        {"image": {"center": [500300.0, 5300200.0, 400.001]}},
        {"image": {"angles": [0.8, -1.2, 3.001]}},
        {"camera": {"lens": {"type": "brown", "k1": 1e-12}}},
        {"orientation": {"rotation": "pok"}},
        {"orientation": {"refraction": True}},
        {"orientation": {"earth_curvature": "correction"}},
        {"terrain": {"height_system": "EPSG:5783"}, "orientation": {"height_system": "EPSG:5783"}},
    ],
    ids=["center", "angles", "lens", "rotation", "refraction", "curvature", "height system"],
)
def test_what_moves_a_pixel_changes_the_key(project: Project, tables: dict[str, Any]) -> None:
    assert key(changed(project, **tables)) != key(project)


@pytest.mark.parametrize(
    "setting",
    [{"kernel": "nearest"}, {"tolerance": 0.01}, {"resolution": 2.0}, {"nodata": "7"}, {"tile": 256}],
    ids=lambda setting: next(iter(setting)),
)
def test_settings_of_pixels_change_the_key(project: Project, setting: dict[str, Any]) -> None:
    assert key(project, **setting) != key(project)


@pytest.mark.parametrize("setting", [{"compress": "lzw"}, {"overviews": False}], ids=["compress", "overviews"])
def test_settings_of_the_file_keep_the_key(project: Project, setting: dict[str, Any]) -> None:
    assert key(project, **setting) == key(project)
