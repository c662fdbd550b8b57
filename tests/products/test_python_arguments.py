"""Arguments of the Python interface that people get wrong: accepted in the form that is meant, or refused by name."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from rasterio.io import MemoryFile
from tools.small_block import CRS, Block

import photoplan as pp
from photoplan.cameras import FrameCamera, Interior, NoLens
from photoplan.errors import GeometryError, InputError, PhotoplanError, PhotoplanWarning, UsageError

SIZE = (60, 40)
GRID = pp.MapGrid(500_000.0, 5_300_020.0, 0.5, 40, 40, CRS)
CAMERA = FrameCamera(
    Interior.digital(SIZE, (50.0, 50.0)), NoLens(), pp.Pose.from_angles((500_010.0, 5_300_010.0, 30.0), (0, 0, 0))
)
PIXELS = (np.arange(3 * 60 * 40) % 251).astype(np.uint8).reshape(3, 40, 60)
PACKAGES = ("", ".cameras", ".matching", ".orientation", ".quality", ".radiometry", ".surfaces", ".targets", ".terrain")


@pytest.fixture
def terrain(tmp_path: Path) -> Path:
    with rasterio.open(tmp_path / "t.tif", "w", driver="GTiff", width=30, height=30, count=1, dtype="float32", crs=CRS,
                       transform=rasterio.Affine(1, 0, 499_995, 0, -1, 5_300_025)) as file:  # fmt: skip
        file.write(np.zeros((30, 30), np.float32), 1)
    return tmp_path / "t.tif"


def test_sources_and_surfaces_in_every_form(terrain: Path, tmp_path: Path) -> None:
    """Asked: text and paths, open datasets, arrays, masked arrays, DataArrays, NumPy's numbers give one result."""
    with rasterio.open(tmp_path / "i.tif", "w", driver="GTiff", width=60, height=40, count=3, dtype="uint8") as file:
        file.write(PIXELS)
    wanted = pp.rectify(PIXELS, CAMERA, GRID, 0.0)
    assert wanted.valid.all()
    last = xarray.DataArray(PIXELS.transpose(1, 2, 0), dims=("y", "x", "band"))
    with rasterio.open(tmp_path / "i.tif") as source, rasterio.open(terrain) as heights, MemoryFile() as memory:
        with memory.open(driver="GTiff", width=60, height=40, count=3, dtype="uint8") as new:
            new.write(PIXELS)
        with memory.open() as inside:
            forms = (
                PIXELS,
                np.ma.masked_array(PIXELS),
                xarray.DataArray(PIXELS, dims=("band", "y", "x")).chunk({"y": 16}),
                last,
                str(tmp_path / "i.tif"),
                tmp_path / "i.tif",
                source,
                inside,
            )
            for form in forms:
                assert np.array_equal(pp.rectify(form, CAMERA, GRID, np.float32(0)).values, wanted.values), type(form)
            assert np.array_equal(
                pp.rectify([PIXELS], [CAMERA], GRID, 0, owner=np.ones((40, 40), int)).values, wanted.values
            )
        for surface in (terrain, str(terrain), heights, 0, np.int64(0), pp.LevelSurface(0.0)):
            assert np.array_equal(pp.rectify(PIXELS, CAMERA, GRID, surface).values, wanted.values), type(surface)


def test_pixels_of_the_other_byte_order() -> None:
    """Arrays of files of other machines ended in an error of the compiler."""
    for kind in ("u2", "i2", "f4"):
        one, other = (pp.rectify(PIXELS.astype(order + kind), CAMERA, GRID, 0.0) for order in "<>")
        assert np.array_equal(one.values, other.values) and other.valid.all()


def test_a_data_array_keeps_what_is_none() -> None:
    holes = PIXELS.astype(np.float32)
    holes[:, 10:20, 20:40] = -9999.0
    array = xarray.DataArray(holes, dims=("band", "y", "x"), attrs={"_FillValue": -9999.0})
    found = pp.rectify(array, CAMERA, GRID, 0.0)
    assert 0 < (~found.valid).sum() < found.valid.size and found.values[:, found.valid].min() > -100
    for name, value in (("missing_value", -9999.0), ("nodatavals", (-9999.0,) * 3), ("nodata", -9999)):
        again = pp.rectify(array.drop_attrs().assign_attrs({name: value}), CAMERA, GRID, 0.0)
        assert np.array_equal(again.valid, found.valid), name
    with pytest.raises(UsageError, match=r"DataArray with dimensions \('a', 'b'\)"):
        pp.rectify(xarray.DataArray(np.zeros((3, 3)), dims=("a", "b")), CAMERA, GRID, 0.0)


WRONG: list[tuple[str, dict[str, Any], str]] = [
    ("text as camera", {"camera": "camera.toml"}, "camera: str 'camera.toml'; give a camera"),
    ("names of cameras", {"source": [PIXELS], "camera": ["one"]}, "camera: str 'one'; give a camera"),
    ("a list with one source", {"camera": [CAMERA]}, "1 cameras and one source, ndarray of shape"),
    ("text with two cameras", {"source": "ab", "camera": [CAMERA, CAMERA]}, "2 cameras and one source, str 'ab'"),
    ("two sources", {"source": [PIXELS, PIXELS], "camera": [CAMERA]}, "2 sources and 1 cameras"),
    ("a list as source", {"source": [PIXELS]}, "source: list; give an array"),
    ("a Dataset of xarray", {"source": xarray.Dataset({"a": ("x", [1])})}, "source: Dataset"),
    ("None", {"source": None}, "source: NoneType"),
    ("rows, columns, bands", {"source": PIXELS.transpose(1, 2, 0)}, r"\(40, 60, 3\); needed is .*transpose\(2, 0, 1\)"),
    ("another size", {"source": PIXELS[:, :20]}, "60 × 20 pixels, its camera has 60 × 40"),
    ("double precision", {"source": PIXELS.astype(float)}, r"float64; needed .*astype\('float32'\)"),
    ("four axes", {"source": PIXELS[None]}, r"shape \(1, 3, 40, 60\)"),
    ("bounds as target", {"target": (0, 0, 1, 1)}, "target: tuple .*give a MapGrid"),
    ("text as target", {"target": CRS}, "target: str .*give a MapGrid"),
    ("degrees", {"target": pp.MapGrid(15.0, 47.8, 1e-5, 9, 9, "EPSG:4326")}, "target: CRS: .* is geographic"),
    ("an array as surface", {"surface": np.zeros((9, 9))}, r"surface: ndarray of shape \(9, 9\); give the path"),
    ("a DataArray as surface", {"surface": xarray.DataArray(np.zeros((9, 9)))}, "surface: DataArray"),
    ("NaN as height", {"surface": float("nan")}, "surface: height nan"),
    ("True as height", {"surface": True}, "surface: bool True"),
    ("None as surface", {"surface": None}, "surface: NoneType"),
    ("owners of another shape", {"owner": np.ones((3, 3), int)}, r"owners of shape \(3, 3\)"),
    ("no tolerance", {"tolerance": float("nan")}, "tolerance"),
    ("text as tolerance", {"tolerance": "0.1"}, "tolerance: str '0.1'; needed is a number"),
    ("part of a thread", {"workers": 1.5}, "workers: float 1.5; needed is a whole number"),
]


@pytest.mark.parametrize(("given", "says"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG])
def test_what_cannot_be_meant_is_refused_by_name(given: dict[str, Any], says: str) -> None:
    words: dict[str, Any] = {"source": PIXELS, "camera": CAMERA, "target": GRID, "surface": 0.0, **given}
    with pytest.raises((UsageError, InputError), match=says):
        pp.rectify(words.pop("source"), words.pop("camera"), words.pop("target"), words.pop("surface"), **words)


def test_a_grid_in_the_wrong_zone(terrain: Path) -> None:
    """It was an orthophoto without one valid pixel."""
    wrong = dataclasses.replace(GRID, crs="EPSG:32634")
    with pytest.raises(UsageError, match=r"are in EPSG:32633; needed is EPSG:32634.*The target's CRS is EPSG:32634"):
        pp.rectify(PIXELS, CAMERA, wrong, terrain)
    with pytest.raises(GeometryError, match="do not meet"):
        pp.rectify(PIXELS, CAMERA, dataclasses.replace(GRID, left=600_000.0), terrain)
    with pytest.warns(PhotoplanWarning, match=r"no pixel of the result is valid.*camera stands at X 500010"):
        found = pp.rectify(PIXELS, CAMERA, dataclasses.replace(GRID, left=600_000.0), 0.0)
    assert not found.valid.any()


def test_text_is_one_name_and_paths_are_paths(small: Block) -> None:
    project = pp.load_project(str(small.project))
    assert [p.images for p in pp.plan_orthophotos(project, "three", resolution=2.0).products] == [("three",)]
    assert project.select("t*") == project.select(["t*"])
    request = pp.ResectRequest(str(small.project), images="three", control=small.folder, sigma_image=np.float32(0.5))
    assert (request.project, request.images, request.control) == (small.project, ("three",), (small.folder,))
    assert type(request.sigma_image) is float and pickle.loads(pickle.dumps(request)) == request
    assert request.replace(images=["a", "b"]).images == ("a", "b")
    for call, says in (
        (lambda: pp.resect_project(str(small.project)), "resect_project: request: str.* needed is ResectRequest"),
        (lambda: pp.plan_orthophotos(small.project), "project: PosixPath; needed is Project .*load_project"),
        (lambda: pp.check_project(str(small.project)), "needed is Project"),
        (lambda: pp.execute(project, "x"), "plan: Project; needed is OrthoPlan"),
        (lambda: pp.ResectRequest(3), "`project`: int 3; needed is a path"),
        (lambda: pp.ResectRequest(""), "the name is empty"),
        (lambda: pp.ResectRequest("p", sigma_control=(1.0,)), "1 values; needed are 2"),
        (lambda: pp.ResectRequest("p", sigma_image="1"), "`sigma_image`: str '1'; needed is a number"),
        (lambda: pp.ResectRequest("p", critical=float("nan")), r"`critical` is not a number \(NaN\)"),
        (lambda: pp.SampleRequest(np.zeros((3, 3)), "a", "b"), r"`model`: ndarray of shape \(3, 3\); needed is a path"),
    ):
        with pytest.raises(UsageError, match=says):
            call()


REQUESTS = [name for name in pp.__all__ if name.endswith("Request")]


@pytest.mark.parametrize("name", REQUESTS)
@pytest.mark.parametrize("value", [{}, 3.5, "", xarray.DataArray([1.0])], ids=["dict", "number", "empty", "DataArray"])
def test_no_request_takes_nonsense_for_a_file(name: str, value: Any) -> None:
    """In every field that is a file or files: an error of ours at birth, not an exception of Python later."""
    request = getattr(pp, name)
    if hasattr(request, "model_fields"):
        declared = [(key, each.annotation, each.is_required()) for key, each in request.model_fields.items()]
    else:
        declared = [(f.name, f.type, f.default is f.default_factory) for f in dataclasses.fields(request)]
    of_files = r"(tuple\[)?(pathlib\.)?Path(, \.\.\.\])?( \| None)?"
    files = [key for key, kind, _ in declared if kind is Path or re.fullmatch(of_files, str(kind))]
    needed = {key for key, _, required in declared if required}
    for field in files if needed <= set(files) else ():
        given: dict[str, Any] = dict.fromkeys(needed, "x")
        with pytest.raises(PhotoplanError, match=field):
            request(**{**given, field: value})


def test_all_public_functions_keep_their_signature() -> None:
    """And are found by pickle, under the names that people use."""
    count = 0
    for end in PACKAGES:
        package = importlib.import_module(f"photoplan{end}")
        for name in package.__all__:
            thing = getattr(package, name)
            if inspect.isfunction(thing):
                count += 1
                assert thing.__doc__ and inspect.signature(thing).parameters
                assert pickle.loads(pickle.dumps(thing)) is thing
    assert count > 60
