"""Every command of README, tutorial and how-to pages runs, section by section, on the inputs that the page speaks of.

Inputs are the included block under the names of the pages, rendered or simulated files, or `../shared/data`. A section
runs in a folder of its own, its commands in order and literally, and each ends with exit code 0.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from tools.camera_model import Sensor, write_frame
from tools.camera_series import edge_frame
from tools.command import inside
from tools.target_scene import wall, write

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
DEMO = ROOT / "src" / "photoplan" / "demo_block"
PAGES = [ROOT / "README.md", DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
#: Commands that only show a form: placeholders, or other programs.
FORM = re.compile(r"…|\[options\]|\[-")


@dataclass(frozen=True)
class Section:
    """The commands of a section of a page, or of a whole page whose sections build on each other."""

    page: str
    title: str
    commands: tuple[tuple[str, ...], ...]

    @property
    def name(self) -> str:
        return f"{self.page}: {self.title}" if self.title else self.page


#: Pages whose sections use what earlier ones made.
WHOLE = {"tutorial", "block", "mosaic", "balance", "terrain-use", "film", "monoplot"}


def commands_of(text: str) -> tuple[tuple[str, ...], ...]:
    found = []
    for block in re.findall(r"^```(?:console|text|bash|)\n(.*?)^```$", text, re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            call = re.match(r"(?:\$ )?(?:\.venv/bin/)?photoplan (.*)", line)
            words = re.split(r"\s+#", call[1])[0] if call else ""
            if words and not FORM.search(words):
                found.append(tuple(shlex.split(words)))
    return tuple(found)


def sections() -> Iterator[Section]:
    for page in PAGES:
        text = page.read_text("utf-8")
        if page.stem in WHOLE:
            parts = [("", text)]
        else:
            heads = re.split(r"^## (.*)$", text, flags=re.M)
            parts = [("", heads[0]), *zip(heads[1::2], heads[2::2])]
        for title, part in parts:
            if commands := commands_of(part):
                yield Section(page.stem, title, commands)


# --- Inputs ---------------------------------------------------------------------------------------------------------


def block(folder: Path, *, terrain: str = "dsm.tif", orientation: str = "ext.csv", images: str = "images") -> None:
    """The included block under the names that a page uses."""
    shutil.copytree(DEMO / "images", folder / images, dirs_exist_ok=True)
    shutil.copy(DEMO / "int.yaml", folder / "int.yaml")
    shutil.copy(DEMO / "dsm.tif", folder / terrain)
    shutil.copy(DEMO / "ext.csv", folder / orientation)
    shutil.copy(DEMO / "ext.prj", folder / Path(orientation).with_suffix(".prj"))


def project(folder: Path, name: str = "", *words: object) -> None:
    """A project of the included block; without a name in the folder itself."""
    block(folder)
    said = inside(
        *("init", folder / name, "--images", f"{folder}/images/*.jpg", "--camera", folder / "int.yaml"),
        *("--orientation", folder / "ext.csv", "--terrain", folder / "dsm.tif", "--height-system", "same", *words),
    )
    assert said.code == 0, said.err


def named_block(folder: Path, name: str = "block") -> None:
    project(folder, name)


def mosaics(folder: Path) -> None:
    """The block, and the polygons of a map series."""
    import shapely

    from photoplan.io.vector_layer import VectorLayer, write_geopackage

    named_block(folder)
    squares = [shapely.box(576690 + 15 * k, 5188140, 576705 + 15 * k, 5188165) for k in range(2)]
    layer = VectorLayer("sheets", "Polygon", squares, {"name": np.array(["west", "east"], object)})
    write_geopackage(folder / "sheets.gpkg", [layer], "EPSG:32615")


def demo_project(folder: Path) -> None:
    project(folder, "demo")


def in_place(folder: Path) -> None:
    project(folder)


def survey(folder: Path, shared: Path) -> None:
    """The road survey, and what other sections make of it."""
    found = shared / "data" / "m3_road_survey" / "M3_Terrain.mm.xml"
    for name in ("survey.xml", "M3_Terrain.mm.xml"):
        shutil.copy(found, folder / name)


def terrace(folder: Path) -> None:
    """The survey of the page on building terrain: a terrace with a road's edge, a wall and a border."""
    rng = np.random.default_rng(4)
    x, y = 500000 + rng.uniform(0, 60, 900), 5300000 + rng.uniform(0, 40, 900)

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ground = 102.0 - 0.2 * np.minimum(y - 5300000, 10.0) + 0.05 * (x - 500000)
        return np.where(y > 5300018, ground + 1.0, ground)

    rows = ["name,east,north,height,code,line,z_right"]
    rows += [f"{k},{a:.3f},{b:.3f},{c:.3f},101,," for k, (a, b, c) in enumerate(zip(x, y, height(x, y)))]
    for line, code, north, step in ((1, 201, 10.0, None), (2, 301, 18.0, 1.0)):
        for k in range(11):
            east, north_m = 500000 + 6.0 * k, 5300000 + north
            z = float(height(np.array(east), np.array(north_m)))
            other = "" if step is None else f"{z:.3f}"
            rows.append(f"{line}{k:03d},{east:.3f},{north_m:.3f},{z + (step or 0):.3f},{code},{line},{other}")
    for k, (a, b) in enumerate([(0, 0), (60, 0), (60, 40), (0, 40), (0, 0)]):
        rows.append(f"9{k:03d},{500000 + a},{5300000 + b},,900,3,")
    (folder / "survey.csv").write_text("\n".join(rows) + "\n")
    page = (DOCS / "howto" / "terrain-build.md").read_text("utf-8")
    codes = re.search(r"^```toml\n(\[codes\]\n.*?)^```$", page, re.M | re.S)
    assert codes
    (folder / "codes.toml").write_text(codes[1])


def cloud(folder: Path) -> None:
    """Laser points of a slope."""
    laspy = pytest.importorskip("laspy")
    rng = np.random.default_rng(2)
    file = laspy.create(point_format=0)
    file.header.scales, file.header.offsets = [0.001] * 3, [500000, 5300000, 0]
    x, y = rng.uniform(0, 80, (2, 4000))
    file.x, file.y, file.z = 500000 + x, 5300000 + y, 100 + 3 * np.sin(x / 15) + rng.normal(0, 0.03, 4000)
    file.classification = np.full(4000, 2, np.uint8)
    file.write(folder / "ground.laz")


def hills(folder: Path, name: str = "dtm.tif", crs: str = "EPSG:25832+7837", lift: float = 0.0) -> None:
    """Terrain of 500 m by 500 m at 1 m."""
    x, y = np.meshgrid(np.arange(500.0), np.arange(500.0))
    z = 40 + 8 * np.sin(x / 60) * np.cos(y / 45) + lift * np.exp(-((x - 200) ** 2 + (y - 260) ** 2) / 900)
    options = {"driver": "GTiff", "dtype": "float32", "count": 1, "width": 500, "height": 500, "crs": crs}
    with rasterio.open(folder / name, "w", transform=from_origin(-1700, 338800, 1, 1), **options) as file:
        file.write(z.astype(np.float32), 1)


def film(folder: Path, shared: Path) -> None:
    """A scan that is rendered from an orthophoto and its terrain, moved into the CRS of the page."""
    from tools.film_scan import ARM, HALF_LINE, RING, Film, read_ground, render

    of = Film((-1497.3, 338546.8, 341.6))
    data = shared / "data" / "vienna_ortho_dtm"
    ground = read_ground(data / "44_2_op_2023_30cm.tif", data / "44_2_dgm.tif")
    scan = render(of, ground)
    (folder / "scans").mkdir(exist_ok=True)
    scan.write(folder / "scans" / "1987_04_112.tif")
    radii, distortion = of.table()
    marks = ", ".join(f"{n} = [{x}, {y}]" for n, (x, y) in of.marks.items())
    (folder / "rc30.toml").write_text(
        f'[cameras.RC30]\ntype = "film"\ncamera_constant_mm = {of.c}\n'
        f"principal_point_mm = {list(of.principal_point)}\nfiducials_mm = {{ {marks} }}\n"
        f'marks = {{ type = "ring_cross", diameter = {2 * RING[1]}, width = {RING[1] - RING[0]:.3f}, arm = {ARM}, '
        f"cross_width = {2 * HALF_LINE} }}\n"
        f'lens = {{ type = "radial_table", radii_mm = {radii}, distortion_um = {distortion} }}\n'
    )
    moved = np.array([500000.0, 4962000.0])
    with rasterio.open(data / "44_2_dgm.tif") as file:
        heights, place = file.read(1), file.transform
    options = {"driver": "GTiff", "dtype": "float32", "count": 1, "nodata": -9999.0, "crs": "EPSG:25832+7837"}
    size = {"width": heights.shape[1], "height": heights.shape[0]}
    corner = from_origin(place.c + moved[0], place.f + moved[1], 1, 1)
    with rasterio.open(folder / "dtm.tif", "w", transform=corner, **options, **size) as file:
        file.write(heights.astype(np.float32), 1)
    rng = np.random.default_rng(11)
    grid = np.array([(c, r) for c in (0.16, 0.39, 0.61, 0.84) for r in (0.16, 0.5, 0.84)])
    at = grid * of.size + rng.uniform(-60, 60, grid.shape)
    XYZ = ground.hit(of.center, of.rays(at)) + np.array([*moved, 0.0])
    points = [f"P{k},1987_04_112,{x:.2f},{y:.2f}" for k, (x, y) in enumerate(at + rng.normal(0, 0.15, at.shape))]
    (folder / "points.csv").write_text("\n".join(["point,image,x,y", *points]) + "\n")
    control = [f"P{k},{X:.3f},{Y:.3f},{Z:.3f}" for k, (X, Y, Z) in enumerate(XYZ)]
    (folder / "control.csv").write_text("\n".join(["name,x,y,z", *control]) + "\n")


def camera_series(folder: Path) -> None:
    """Frames of a simulated sensor, and the series file of the page on cameras."""
    sensor = Sensor(shape=(64, 80), full_well=6000.0, dsnu=4.0, prnu=0.01, hot={(10, 20): 800.0})
    noise = np.random.default_rng(0)
    for t in (2, 5, 8, 12, 16, 20, 24, 28, 34, 40, 50):
        for k in range(6 if t == 16 else 2):
            write_frame(folder / f"flat/flat_{t}ms_{k}.tif", sensor.frame(400.0 * t, t, noise))
            write_frame(folder / f"dark/dark_{t}ms_20C_{k}.tif", sensor.frame(0, t, noise))
            disc = np.zeros((64, 80))
            disc[24:40, 30:46] = 400.0 * t
            write_frame(folder / f"lamp/lamp_{t}ms_{k}.tif", sensor.frame(disc, t, noise))
    page = (DOCS / "howto" / "camera.md").read_text("utf-8")
    text = re.search(r"^```toml\n(\[camera\]\n.*?)^```$", page, re.M | re.S)
    assert text
    (folder / "camera.toml").write_text(text[1].replace('bayer = "RGGB"\n', ""))


def mountains(folder: Path, shared: Path) -> None:
    """A DTM of mountains with an orthophoto, lines, names and paths, as the page on views uses them."""
    found = shared / "data" / "austria_dtm10m" / "dhm_at_lamb_10m_2018.tif"
    for name in ("dtm.tif", "dem.tif"):
        shutil.copy(found, folder / name)
    with rasterio.open(found) as file:
        options = {**file.profile, "dtype": "uint8", "count": 3, "nodata": None}
        heights = file.read(1)
    with rasterio.open(folder / "ortho.tif", "w", **options) as file:
        grey = np.clip((heights - 300) / 8, 1, 255).astype(np.uint8)
        file.write(np.stack([grey, grey, 255 - grey]))
    write_layers(folder)


def write_layers(folder: Path) -> None:
    import pyogrio
    import shapely
    from pyogrio.raw import write

    def layer(file: str, shapes: list, layer: str, **fields: list) -> None:
        write(
            folder / file,
            geometry=np.array(shapely.to_wkb(shapes), object),
            field_data=[np.array(values, object if isinstance(values[0], str) else None) for values in fields.values()],
            fields=[*fields],
            layer=layer,
            geometry_type=shapes[0].geom_type,
            crs="EPSG:31287",
            driver="GPKG" if file.endswith("gpkg") else "GeoJSON",
        )

    assert pyogrio
    road = shapely.LineString([(552500, 427500), (554000, 428500), (556500, 429500)])
    layer("roads.gpkg", [road], "main", **{"class": ["a"], "class_colour": ["#ff0000"]})
    layer("peaks.geojson", [shapely.Point(556000, 429000)], "peaks", name=["Peak"])
    layer("flight.gpkg", [shapely.LineString([(552300, 427000), (552380, 427060)])], "flight", name=["a"])
    (folder / "stations.csv").write_text("x,y,height\n552300,427000,60\n552340,427030,60\n")


def two_ortho(folder: Path) -> None:
    """Two orthophotos of one place, the second shifted by a fraction of a pixel."""
    from scipy import ndimage

    rng = np.random.default_rng(3)
    scene = ndimage.gaussian_filter(rng.normal(128, 400, (420, 420)), 2.0) + 0
    options = {"driver": "GTiff", "dtype": "uint8", "count": 1, "width": 400, "height": 400, "crs": "EPSG:25832"}
    for name, shift in (("ortho2024.tif", 0.0), ("ortho2026.tif", 0.26)):
        values = np.clip(ndimage.shift(scene, shift, order=3)[10:410, 10:410], 0, 255).astype(np.uint8)
        with rasterio.open(folder / name, "w", transform=from_origin(500000, 5300000, 0.5, 0.5), **options) as file:
            file.write(values, 1)


def lit_slopes(folder: Path) -> None:
    """An orthophoto of hills, lit from the south-east."""
    x, y = np.meshgrid(np.arange(300.0), np.arange(300.0))
    z = 60 * np.sin(x / 40) * np.cos(y / 55)
    slope_y, slope_x = np.gradient(-z)
    azimuth, altitude = np.radians([135, 38])
    sun = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    normal = np.stack([slope_x, -slope_y, np.ones_like(z)]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    lit = np.clip(np.tensordot(sun, normal, 1), 0, None)
    place = {"transform": from_origin(500000, 5300000, 1, 1), "crs": "EPSG:25832", "width": 300, "height": 300}
    with rasterio.open(folder / "dtm.tif", "w", driver="GTiff", dtype="float32", count=1, **place) as file:
        file.write(z.astype(np.float32), 1)
    noise = np.random.default_rng(1).normal(0, 2, (3, 300, 300))
    grey = np.stack([120 * lit + 25, 110 * lit + 30, 80 * lit + 40]) + noise
    with rasterio.open(folder / "ortho.tif", "w", driver="GTiff", dtype="uint8", count=3, **place) as file:
        file.write(np.clip(grey, 0, 255).astype(np.uint8))


def with_points(folder: Path) -> None:
    in_place(folder)
    (folder / "points.csv").write_text("name,x,y\nroof,640,360\ncar,256.5,192\nsky,3000,10\n")
    (folder / "road.geojson").write_text(
        '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": '
        '{"type": "LineString", "coordinates": [[600, -330], [640, -360], [660, -400]]}}]}'
    )


def typical_jobs(folder: Path, shared: Path) -> None:
    """The included block under the names of the README, positions with their accuracy, and the road survey."""
    block(folder)
    shutil.copy(DEMO / "int.yaml", folder / "camera.yaml")
    rows = [row.split(",")[:4] for row in (DEMO / "ext.csv").read_text().splitlines()[1:]]
    stated = ["name,x,y,z,sigma_x,sigma_y,sigma_z", *(",".join([*row, "0.1", "0.1", "0.1"]) for row in rows)]
    (folder / "gnss.csv").write_text("\n".join(stated) + "\n")
    survey(folder, shared)


def data_sheet(folder: Path) -> None:
    """A sensor by its data sheet, and the degradation of the page on simulation."""
    shutil.copy(DOCS / "templates" / "sensor-frame.toml", folder / "sensor.toml")
    page = (DOCS / "reference" / "simulate.md").read_text("utf-8")
    model = re.search(r"^```toml\n(seed = 1\n.*?)^```$", page, re.M | re.S)
    assert model
    (folder / "model.toml").write_text(model[1])


def without_lens(folder: Path) -> None:
    """The block with corrected images, and an orientation of BINGO."""
    project(folder)
    text = (folder / "project.toml").read_text()
    (folder / "project.toml").write_text(re.sub(r"^lens = .*$", "", text, flags=re.M))
    rows = ["ORIA  4711  500000.0  5300000.0  2000.0  0.5  -0.3  101.2  Camera"]
    (folder / "itera.dat").write_text("\n".join(rows) + "\n")


def sharp_images(folder: Path, to: str = "images", ending: str = "jpg") -> None:
    """Images with edges along rows and columns."""
    (folder / to).mkdir(exist_ok=True)
    rng = np.random.default_rng(1)
    rows = np.arange(400.0)
    for k in range(3):
        edges = [place + 0.08 * rows for place in (90.0 + 3 * k, 200.0, 310.0)]
        frame = edge_frame(rng, (400, 400), edges)
        frame = np.clip(frame.T if k == 1 else frame, 0, 255).astype(np.uint8)[None]
        more = {"quality": 100} if ending == "jpg" else {}
        size = {"count": 1, "width": 400, "height": 400, "dtype": "uint8"}
        with rasterio.open(folder / to / f"{k}.{ending}", "w", **size, **more) as file:
            file.write(frame)


def chart(folder: Path) -> None:
    """An edge chart, and a laboratory's table."""
    sharp_images(folder, "chart", "tif")
    shutil.copy(folder / "chart" / "0.tif", folder / "chart.tif")
    (folder / "lens.csv").write_text("cycles_per_px,mtf\n0,1\n0.1,0.95\n0.3,0.8\n0.5,0.6\n")


def terrain_model(folder: Path) -> None:
    """`terrain.gpkg` and a ramp of colours for maps."""
    terrace(folder)
    words = ("--codes", folder / "codes.toml", "--crs", "EPSG:25832", "--height-system", "EPSG:7837")
    said = inside("dtm", "build", folder / "survey.csv", *words, "-o", folder / "terrain.gpkg")
    assert said.code == 0, said.err
    (folder / "colours.txt").write_text("100 0 97 71\n101 255 255 190\n103 102 51 0\n")


def built_terrace(folder: Path) -> None:
    terrain_model(folder)
    shutil.copy(folder / "terrain.gpkg", folder / "terrace.gpkg")


def models(folder: Path) -> None:
    """Models to look at, to sample and to put into each other."""
    import shapely

    terrace(folder)
    words = ("--codes", folder / "codes.toml", "--crs", "EPSG:25832", "--height-system", "EPSG:7837")
    for name, more in (("model", ()), ("fine", ("--grid-width", 0.5)), ("coarse", ("--grid-width", 2))):
        said = inside("dtm", "build", folder / "survey.csv", *words, *more, "-o", folder / f"{name}.gpkg")
        assert said.code == 0, said.err
    (folder / "points.csv").write_text("x,y\n500010,5300005\n500030.5,5300021\n")
    polygons(folder / "where.geojson", {"a": shapely.box(500020, 5300004, 500040, 5300014)}, "EPSG:25832")
    from photoplan.io.vector_layer import VectorLayer, write_geopackage

    axis = VectorLayer("axis", "LineString", [shapely.LineString([(500002, 5300005), (500050, 5300030)])], {})
    write_geopackage(folder / "axis.gpkg", [axis], "EPSG:25832")


def polygons(path: Path, shapes: dict[str, Any], crs: str) -> None:
    """Write polygons with their names as GeoJSON."""
    import shapely

    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": json.loads(shapely.to_geojson(shape))}
        for name, shape in shapes.items()
    ]
    named = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": named, "features": features}))


def before_and_after(folder: Path) -> None:
    import shapely

    hills(folder, "before.tif", "EPSG:31287")
    hills(folder, "after.tif", "EPSG:31287", lift=6.0)
    boxes = {"heap": shapely.box(-1540, 338500, -1460, 338580), "pit": shapely.box(-1400, 338400, -1340, 338460)}
    polygons(folder / "parts.geojson", boxes, "EPSG:31287")
    (folder / "posts.csv").write_text("name,x,y,height\ntower,-1500,338550,10\ngate,-1400,338450,2\n")
    (folder / "outlets.csv").write_text("name,x,y\noutfall,-1450,338500\n")


def town(folder: Path) -> None:
    """The block with houses, and a bridge in a file of its own."""
    import shapely

    from photoplan.io.vector_layer import VectorLayer, write_geopackage

    project(folder)
    deck = shapely.Polygon(
        [(576705, 5188150, 165), (576725, 5188150, 166), (576725, 5188156, 166), (576705, 5188156, 165)]
    )
    layer = VectorLayer("bridges", "Polygon Z", [deck], {"name": np.array(["A45"], object)})
    write_geopackage(folder / "bridges.gpkg", [layer], "EPSG:32615")
    text = (folder / "project.toml").read_text()
    entry = '[[objects]]\nfile = "bridges.gpkg"\nheight_system = "same"\n'
    (folder / "project.toml").write_text(text + "\n" + entry)


def block_and_mountains(folder: Path, shared: Path) -> None:
    """Both scenes of the page on views."""
    mountains(folder, shared)
    project(folder)


def seen_image(folder: Path, shared: Path) -> None:
    block_and_mountains(folder, shared)
    said = inside("ortho", folder / "project.toml", "--images", "DJI_0026", "--resolution", "0.2")
    assert said.code == 0, said.err


def facade(folder: Path) -> None:
    """A wall behind a pillar, as a target of the project."""
    (folder / "facade").mkdir()
    place = wall()
    write(place, folder / "facade", f'[targets.south]\nframe = "{place.stated}"\nbounds = {list(place.bounds)}\n')


#: What a section needs before it runs, by the page's name, or by page and title.
STAGES: dict[str, Callable[..., None]] = {
    "README: Try it": lambda folder: None,
    "README: Three typical jobs": typical_jobs,
    "tutorial": lambda folder: None,
    "mosaic": mosaics,
    "balance": named_block,
    "quality-report": named_block,
    "build-report": survey,
    "large": in_place,
    "monoplot": with_points,
    "film": film,
    "register": two_ortho,
    "illumination": lit_slopes,
    "camera: Write the series file": camera_series,
    "camera: From a data sheet": data_sheet,
    "orientation: From one format to another": without_lens,
    "sharpness: Measure an image flight": sharp_images,
    "sharpness: Compare with the laboratory": chart,
    "sharpness: Make images sharper": sharp_images,
    "surface": demo_project,
    "terrain-build: In one command": survey,
    "terrain-build: From a laser scan": cloud,
    "terrain-build: Gross errors": built_terrace,
    "terrain-build": terrace,
    "terrain-maps": terrain_model,
    "terrain-use": models,
    "terrain-volumes": before_and_after,
    "true-orthophoto": town,
    "facades": facade,
    "views": block_and_mountains,
    "views: With the camera of an image": seen_image,
}
#: Sections about inputs that cannot be had here, with the tests that run the same commands on such inputs.
ELSEWHERE = {
    "block": "tests/slow/test_block_howto.py",
    "camera: Correct light fall-off": "tests/products/test_restore_fall_off.py",
    "orientation: Tables": "tests/cli/test_convert_command.py",
    "satellites: Rational polynomials": "tests/products/test_satellites.py",
    "satellites: Corrections by `adjust`": "tests/real/test_rpc_adjusted.py",
    "satellites: Line cameras": "tests/cameras/test_line.py",
    "satellites: Frame cameras of planetary missions": "tests/cameras/test_csm_frame.py",
    "surface: Over a wall or a vault, along an image": "tests/products/test_surface_target.py",
    "true-orthophoto: Try it on a known scene": "tests/products/test_rendered_project.py",
    "views: The skyline of a photograph": "tests/real/test_aletsch.py",
}
#: Programs that commands of a page call.
PROGRAMS = {"views: Along a path, and in pairs": "ffmpeg"}


def test_sections_that_run_elsewhere_exist() -> None:
    names = {section.name for section in sections()}
    assert set(ELSEWHERE) <= names
    assert all((ROOT / path).is_file() for path in ELSEWHERE.values())
    assert all(section.name in ELSEWHERE or _stage(section) is not None for section in sections())


def _stage(section: Section) -> Callable[..., None] | None:
    return STAGES.get(section.name, STAGES.get(section.page))


@pytest.mark.slow
@pytest.mark.parametrize("section", [pytest.param(s, id=s.name) for s in sections() if s.name not in ELSEWHERE])
def test_commands_of_a_page(section: Section, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request) -> None:
    if section.name in PROGRAMS and shutil.which(PROGRAMS[section.name]) is None:
        pytest.skip(f"needs {PROGRAMS[section.name]} on the PATH")
    stage = _stage(section)
    assert stage is not None
    names = stage.__code__.co_varnames[: stage.__code__.co_argcount]
    stage(tmp_path, *([request.getfixturevalue("shared")] if "shared" in names else []))
    monkeypatch.chdir(tmp_path)
    for words in section.commands:
        if "edited.gpkg" in words:  # a person edits the regions of a mosaic
            shutil.copy(tmp_path / "block" / "products" / "mosaic_seams.gpkg", tmp_path / "edited.gpkg")
        given: list[str] = []
        for k, word in enumerate(words):
            # The shell expands what is not quoted; patterns of options are quoted on the pages.
            expanded = sorted(map(str, Path().glob(word))) if "*" in word and not words[k - 1].startswith("--") else []
            given += expanded or [word]
        said = inside(*given)
        assert said.code == 0, f"photoplan {' '.join(words)}\n{said.err}"


@pytest.mark.slow
def test_python_of_the_readme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named_block(tmp_path)
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text("utf-8"), re.M | re.S)
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
    assert len(list((tmp_path / "block" / "products").glob("*_ortho.tif"))) == 18
