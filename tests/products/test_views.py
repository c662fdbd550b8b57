"""Views: pictures and matrices of a small block, contents, cameras, what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.command import inside, unfinished_numbers
from tools.small_block import SIZE, X0, Y0, Block, write_block

from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.plan import product
from photoplan.products.run import Run
from photoplan.products.view.camera import open_view_ground, view_camera
from photoplan.products.view.content import class_colours
from photoplan.products.view.make import ViewAddress, ViewPlan, hazy, make_view, plan_view
from photoplan.products.view.measure import pick
from photoplan.requests.view import CameraRequest, ContentRequest, LookRequest, PickRequest, ViewRequest
from photoplan.surfaces.seen import best_photos

STAND = CameraRequest(position=(X0 - 80, Y0 - 60), height=40.0, look_at=(X0 + 20, Y0 + 10), size=(60, 40))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Block:
    return write_block(tmp_path_factory.mktemp("views") / "block")


def made(request: ViewRequest) -> tuple[ViewPlan, np.ndarray]:
    plan = plan_view(request)
    make_view(plan, Run(overwrite=True))
    assert request.output is not None
    with rasterio.open(request.output) as file:
        return plan, file.read()


def test_a_matrix_holds_ground_that_lies_in_its_pixels_on_the_terrain(small: Block, tmp_path: Path) -> None:
    request = ViewRequest(small.terrain, STAND, output=tmp_path / "m.tif", kind="matrix")
    plan, bands = made(request)
    ground = open_view_ground(small.terrain)
    XYZ = np.moveaxis(bands[:3], 0, -1)
    there = np.isfinite(XYZ[..., 2])
    assert 0.3 < there.mean() < 1 and bands.dtype == np.float64
    np.testing.assert_allclose(ground.terrain.heights(XYZ[there][:, :2]), XYZ[there][:, 2], atol=1e-4)
    v, u = np.nonzero(there)
    uvh = plan.camera.target.to_view(XYZ[there])
    np.testing.assert_allclose(uvh[:, :2], np.stack([u, v], axis=-1), atol=1e-4)
    np.testing.assert_allclose(
        bands[3][there], np.linalg.norm(XYZ[there] - plan.camera.target.center, axis=1), rtol=1e-5
    )
    assert ((bands[4][there] >= 0) & (bands[4][there] <= 90)).all() and (bands[6][there] == 0).all()
    record = json.loads((tmp_path / "m.run.json").read_text())
    assert (
        record["view"]["camera"]["azimuth"] == plan.camera.request.azimuth and record["view"]["error_bound_m"] == 0.01
    )
    assert record["product"]["sky_rays"] == int((~there).sum())
    with rasterio.open(tmp_path / "m.tif") as file:
        assert file.descriptions[:3] == ("E", "N", "H") and file.units[0] == "metre" and file.crs is None


def test_a_matrix_gives_the_picture_that_looking_again_gives(small: Block, tmp_path: Path) -> None:
    made(ViewRequest(small.terrain, STAND, output=tmp_path / "m.tif", kind="matrix"))
    look = LookRequest(
        contents=tuple(map(ContentRequest.parse, ("tint:grey:50:150", "shade@0.7", "slope@0.2"))), samples=1
    )
    _, again = made(ViewRequest(small.terrain, STAND, output=tmp_path / "a.png", look=look))
    _, kept = made(ViewRequest(small.terrain, None, output=tmp_path / "b.png", look=look, matrix=tmp_path / "m.tif"))
    np.testing.assert_array_equal(again, kept)
    other = CameraRequest(position=(X0, Y0), azimuth=0.0)
    with pytest.raises(InputError, match="of another view"):
        plan_view(ViewRequest(small.terrain, other, look=look, matrix=tmp_path / "m.tif"))
    with pytest.raises(InputError, match="is no coordinate matrix"):
        plan_view(ViewRequest(small.terrain, None, look=look, matrix=small.terrain))


def test_the_orthophoto_seen_by_the_camera_that_took_it_is_its_image(small: Block, tmp_path: Path) -> None:
    words = ["--images", "one", "--resolution", 0.8, "--no-quicklook", "--output", tmp_path]
    assert inside("ortho", small.project, *words).code == 0
    look = LookRequest(contents=(ContentRequest.parse(str(tmp_path / "one_ortho.tif")),), samples=1)
    camera = CameraRequest(image="one")
    plan, seen = made(ViewRequest(small.project, camera, output=tmp_path / "v.tif", look=look))
    assert plan.camera.target.bundle.size == SIZE
    with rasterio.open(small.images[0]) as file:
        image = file.read(1).astype(float)
    inner = np.s_[20:-20, 20:-20]
    # Resampled twice: half a grey step of a texture whose grey values spread by more than twenty.
    off = seen[0][inner].astype(float) - image[inner]
    assert np.std(image[inner]) > 15 and np.median(np.abs(off)) < 2 and np.abs(off).mean() < 4
    # The photo itself as content is the image, resampled at its own pixels.
    look = LookRequest((ContentRequest.parse("photo:one"),), samples=1)
    _, direct = made(ViewRequest(small.project, camera, output=tmp_path / "d.png", look=look))
    assert np.abs(direct[0][inner].astype(float) - image[inner]).max() <= 1


def test_each_pixel_takes_the_photo_that_shows_it_finest(small: Block, tmp_path: Path) -> None:
    camera = CameraRequest(position=(X0 + 60, Y0), altitude=500.0, azimuth=0.0, pitch=-90.0, size=(90, 30))
    pictures = {}
    for what in ("photos", "photo:one", "photo:two", "photo:three"):
        look = LookRequest((ContentRequest.parse(what),), samples=1, kernel="nearest")
        pictures[what] = made(ViewRequest(small.project, camera, output=tmp_path / "p.png", look=look))[1][0]
    best = pictures.pop("photos")
    nodata = LookRequest().nodata[0]
    ours = [(picture == best) & (picture != nodata) for picture in pictures.values()]
    assert np.mean(np.any(ours, axis=0) | (best == nodata)) == 1
    # The projection centres lie from west to east, 60 m apart: so do their regions.
    plan = plan_view(ViewRequest(small.project, camera, look=LookRequest((ContentRequest.parse("photos"),))))
    view = plan.address.open()
    seen = view.surface.look(view.target, view.target.window)
    (layer,) = view.layers
    cameras = [source.camera for source in layer.sources]
    owner = best_photos(cameras, seen, view.surface)
    first, second, third = np.argsort([camera.center[0] for camera in cameras]) + 1
    east = [seen.XYZ[owner == k, 0].mean() for k in (first, second, third)]
    assert east[0] < east[1] < east[2] and (owner[seen.owner < 0] == 0).all()


def test_a_raster_of_another_crs_lies_where_it_belongs(small: Block, tmp_path: Path) -> None:
    """Grey values are the north-south position in UTM zone 33; the raster lies in zone 32."""
    from photoplan.geometry.crs import crs_step

    step = crs_step("EPSG:32633", "EPSG:32632", (X0 - 500, Y0 - 500, X0 + 500, Y0 + 500))
    back = crs_step("EPSG:32632", "EPSG:32633", (0, 5_200_000, 1_000_000, 5_400_000))
    x, y = step(np.array([X0, Y0]))
    at = np.stack(np.meshgrid(x + np.arange(-400, 400, 8.0) + 4, y - np.arange(-400, 400, 8.0) - 4), axis=-1)
    values = (back(at)[..., 1] - Y0).astype(np.float32)
    profile = {"driver": "GTiff", "width": 100, "height": 100, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    transform = rasterio.transform.from_origin(x - 400, y + 400, 8, 8)
    with rasterio.open(tmp_path / "north.tif", "w", transform=transform, **profile) as file:
        file.write(values, 1)
    look = LookRequest((ContentRequest.parse(str(tmp_path / "north.tif")),), samples=1)
    _, bands = made(ViewRequest(small.terrain, STAND, output=tmp_path / "m.tif", kind="matrix"))
    _, picture = made(ViewRequest(small.terrain, STAND, output=tmp_path / "p.png", look=look))
    low, high = np.percentile(values, (2, 98))
    wanted = np.clip((bands[1] - Y0 - low) * 255 / (high - low), 0, 255)
    there = np.isfinite(wanted)
    # A pixel is the mean of what it covers: on a crest, seen at 86°, that is 35 m and not known to a hundredth.
    assert np.abs(picture[0][there] - wanted[there]).max() < 2.0
    flatter = there & (bands[4] < 85)
    assert flatter.sum() > 0.9 * there.sum() and np.abs(picture[0][flatter] - wanted[flatter]).max() < 1.0


def test_haze_follows_equation_5_8_of_ecker() -> None:
    got = hazy(np.full((3, 1, 2), 40.0, np.float32), np.array([[0.0, 5000.0]]), 0.1, (128, 128, 128))
    np.testing.assert_allclose(got[0, 0], [40, 40 * np.exp(-0.5) + 128 * (1 - np.exp(-0.5))], rtol=1e-6)


def test_shadows_darken_what_the_sun_does_not_reach(small: Block, tmp_path: Path) -> None:
    camera = CameraRequest(position=(X0, Y0), altitude=600.0, azimuth=0.0, pitch=-90.0, size=(60, 40))
    grey = (ContentRequest.parse("tint:grey:-1000:9000"),)
    lit, low = ({"sun": (90.0, a), "shadows": True, "samples": 1} for a in (80.0, 1.0))
    bright, dark = (
        made(ViewRequest(small.terrain, camera, output=tmp_path / "s.png", look=LookRequest(grey, **how)))[1]
        for how in (lit, low)
    )
    share = np.mean(dark[0] < bright[0])
    assert 0.05 < share < 0.95 and (dark[0] <= bright[0]).all()


@pytest.mark.parametrize("changes", [{"panorama": "cylinder"}, {"panorama": "sphere"}, {"curvature": "strict"},
                                     {"exaggeration": 2.0}, {"curvature": "none"}, {"roll": 30.0}])  # fmt: skip
def test_a_resolved_camera_is_the_same_camera(small: Block, changes: dict) -> None:
    """A record or matrix says in numbers what a user has said by the ground."""
    ground = open_view_ground(small.terrain)
    given = {**vars(STAND), **changes}
    made_once = view_camera(CameraRequest(**given), ground)
    again = view_camera(made_once.request, ground)
    uvh = np.stack([*np.meshgrid(np.arange(0.0, 60, 7), np.arange(0.0, 40, 7)), np.full((6, 9), 90.0)], axis=-1)
    np.testing.assert_allclose(again.target.to_ground(uvh), made_once.target.to_ground(uvh), atol=1e-5)
    assert again.request == made_once.request or changes.get("curvature") == "strict"
    middle = made_once.target.to_view(np.append(STAND.look_at, ground.terrain.heights(np.array(STAND.look_at))))
    np.testing.assert_allclose(middle[:2], [29.5, 19.5], atol=1e-6)
    height = 40.0
    assert made_once.above_ground == pytest.approx(height, abs=1e-6)


def test_what_cannot_be_seen_or_written_is_refused(small: Block, tmp_path: Path) -> None:
    def view(camera: CameraRequest, **more: object) -> ViewPlan:
        return plan_view(ViewRequest(small.terrain, camera, **more))  # type: ignore[arg-type]

    at = {"position": (X0, Y0)}
    with pytest.raises(GeometryError, match=r"lies .* m below the ground"):
        view(CameraRequest(**at, altitude=0.0, azimuth=0.0))
    with pytest.raises(GeometryError, match="no ground is seen; the terrain is"):
        view(CameraRequest(**at, azimuth=0.0, pitch=60.0))
    assert view(CameraRequest(**at, azimuth=0.0, pitch=60.0), force=True).first.ground == 0
    with pytest.raises(InputError, match="no height there"):
        view(CameraRequest(position=(0.0, 0.0), azimuth=0.0))
    with pytest.raises(UsageError, match="has no images"):
        view(CameraRequest(image="one"))
    with pytest.raises(UsageError, match="is written as"):
        view(CameraRequest(**at, azimuth=0.0), output=tmp_path / "picture.gif")
    for wrong in ({}, {"azimuth": 0.0, "look_at": (1.0, 2.0)}, {"azimuth": 0.0, "size": (0, 5)},
                  {"azimuth": 0.0, "field_of_view": 200.0}, {"azimuth": float("nan")},
                  {"azimuth": 0.0, "size": (300_000, 10)}, {"azimuth": 0.0, "exaggeration": -1.0}):  # fmt: skip
        with pytest.raises(UsageError):
            CameraRequest(**at, **wrong)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="must be a file, or shade"):
        ContentRequest.parse("nothing.tif")


def test_picking_goes_both_ways_and_says_what_hides(small: Block, tmp_path: Path) -> None:
    view = (small.project, CameraRequest(image="two"))
    pixels = ((20.0, 30.0), (100.25, 71.5), (190.0, 140.0))
    ground = pick(PickRequest(*view, pixels=pixels))
    points = tuple((each.E, each.N, each.H) for each in ground)
    back = pick(PickRequest(*view, points=points, output=tmp_path / "picked.csv"))
    np.testing.assert_allclose([(b.x, b.y) for b in back], pixels, atol=1e-6)
    assert all(each.seen and each.surface == "terrain" for each in (*ground, *back))
    below = pick(PickRequest(*view, points=((points[1][0], points[1][1], points[1][2] - 10),)))[0]
    assert not below.seen
    lines = (tmp_path / "picked.csv").read_text().splitlines()
    assert lines[0].startswith("name,x,y,E,N,H") and len(lines) == 4
    with pytest.raises(UsageError, match="nothing to pick"):
        pick(PickRequest(*view))


def test_commands_say_what_will_be_seen_and_take_files_of_cameras(small: Block, tmp_path: Path) -> None:
    (tmp_path / "camera.toml").write_text(
        f"position = [{X0 - 80}, {Y0 - 60}]\nheight = 40\nlook_at = [{X0 + 20}, {Y0 + 10}]\nsize = [60, 40]\n"
    )
    words = [small.terrain, "--camera", tmp_path / "camera.toml"]
    said = inside("view", *words, "--dry-run")
    assert said.code == 0 and "m above ground" in said.out and "sky" in said.out
    facts = json.loads(inside("view", *words, "--fov", 30, "--dry-run", "--json").out)
    assert facts["field_of_view_deg"][0] == pytest.approx(30) and facts["camera"]["height"] == 40
    assert inside("view", *words).code == 2
    out = tmp_path / "new" / "v.jpg"
    said = inside("view", *words, "-o", out, "--json", "-q")
    assert said.code == 0 and json.loads(said.out)["sky_rays"] > 0 and out.exists()
    assert inside("view", *words, "-o", out).code == 2
    assert inside("view", *words, "-o", small.terrain, "--overwrite").code == 2
    picked = inside("view", "pick", *words, "--pixel", 30, 35, "--json")
    assert json.loads(picked.out)["picked"][0]["seen"] is True
    (tmp_path / "camera.toml").write_text("position = 'here'\n")
    assert inside("view", *words, "--dry-run").code == 3


def test_the_word_panorama_looks_all_around_from_the_north(small: Block, tmp_path: Path) -> None:
    words = (small.terrain, "--from", X0, Y0, "--height", 30, "--size", 90, 20, "--samples", 1, "-q")
    for name, more in (("a", ("panorama",)), ("c", ("panorama", "--panorama", "sphere"))):
        assert inside("view", *more, *words, "-o", tmp_path / f"{name}.png").code == 0
    stated = ("--azimuth", 0, "--panorama", "cylinder", "-o", tmp_path / "b.png")
    assert inside("view", *words, *stated).code == 0
    a, b, c = (rasterio.open(tmp_path / f"{name}.png").read() for name in "abc")
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()
    said = inside("view", "panorama", small.terrain, "--from", X0, Y0, "--look-at", X0, Y0, "--dry-run")
    assert said.code == 2 and "sphere" in said.err
    for word in ("picture", "panorama"):
        more = () if word == "panorama" else ("--size", 90, 20)
        said = inside("view", word, small.project, "--camera", "one", *more, "--dry-run")
        assert said.code == 2 and "an image is seen with its own camera" in said.err


def test_an_input_that_changes_is_noticed(small: Block, tmp_path: Path) -> None:
    model = tmp_path / "dem.tif"
    model.write_bytes(small.terrain.read_bytes())
    plan = plan_view(ViewRequest(model, STAND))
    digests = tuple((path, "0" * 64) for path, _ in plan.address.digests)
    with pytest.raises(InputError, match="has changed"):
        ViewAddress(**{**vars(plan.address), "digests": digests}).open()


def test_fault_20_terrain_in_degrees_or_without_a_crs_is_refused(tmp_path: Path) -> None:
    for crs, told in (("EPSG:4326", "geographic|degrees"), (None, "no CRS")):
        path = tmp_path / "t.tif"
        transform = rasterio.transform.from_origin(11, 47, 1e-4, 1e-4)
        with rasterio.open(path, "w", driver="GTiff", width=9, height=9, count=1, dtype="float32", crs=crs,
                           transform=transform) as file:  # fmt: skip
            file.write(np.full((1, 9, 9), 500, np.float32))
        said = inside("view", path, "--from", 11.0004, 46.9996, "--azimuth", 0, "--dry-run")
        assert said.code == 3 and re.search(told, said.err), said.err


def test_faults_30_32_absurd_numbers_and_pictures_are_refused(small: Block) -> None:
    stand = ["--from", X0, Y0]
    for words in (["--from", 1e300, 5e6], [*stand, "--altitude", 1e300], [*stand, "--height", 1e9],
                  [*stand, "--roll", 1e5], ["--from", 1e9, Y0, "--force"], [*stand, "--altitude", 1e7, "--force"],
                  [*stand, "--exaggeration", 2, "--reference", 1e9], [*stand, "--size", 10**9, 5],
                  [*stand, "--fov", 1e-9], [*stand, "--earth-radius", 6.38]):  # fmt: skip
        said = inside("view", small.terrain, *words, "--azimuth", 0, "--dry-run")
        assert said.code in (1, 2, 3) and "photoplan:" in said.err, said.err


def test_picking_says_what_has_no_pixel_without_numbers_that_are_none(small: Block) -> None:
    words = ["view", "pick", small.terrain, "--from", X0, Y0, "--azimuth", 0]
    said = inside(*words, "--ground", X0 + 5, Y0 - 90, "--ground", 0, 0)
    assert said.code == 0 and not unfinished_numbers(said.out), said.out
    assert re.search(r"point 1: behind the camera = .*: not seen\n", said.out)
    assert "point 2: 0.000 0.000: not seen (the terrain has no height there)" in said.out
    assert inside(*words, "--pixel", 1e300, 0).code == 2


def test_fault_06_a_bound_on_memory_is_kept_or_refused(small: Block, tmp_path: Path) -> None:
    words = [small.terrain, "--from", X0, Y0, "--azimuth", 0, "--size", 50, 40, "-o", tmp_path / "v.png"]
    said = inside("view", *words, "--memory", "10MB")
    assert said.code == 2 and "at least" in said.err


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_class_rasters_keep_their_classes(small: Block, tmp_path: Path, samples: int) -> None:
    """Every colour of the picture is one of the colour table, or the sky; nothing in between."""
    table = {0: (250, 10, 10), 1: (10, 240, 20), 2: (30, 20, 230), 3: (200, 200, 40)}
    with rasterio.open(small.terrain) as terrain:
        profile = {"crs": terrain.crs, "transform": terrain.transform, "width": terrain.width, "height": terrain.height}
    rng = np.random.default_rng(8)
    classes = rng.integers(0, 4, (1, profile["height"], profile["width"]), dtype=np.uint8)
    with rasterio.open(tmp_path / "c.tif", "w", driver="GTiff", count=1, dtype="uint8", **profile) as file:
        file.write(classes)
        file.write_colormap(1, table)
    look = LookRequest(contents=(ContentRequest.parse(str(tmp_path / "c.tif")),), samples=samples, sky=(1, 2, 3))
    _, picture = made(ViewRequest(small.terrain, STAND, output=tmp_path / "v.tif", look=look))
    found = {tuple(map(int, colour)) for colour in np.moveaxis(picture[:3], 0, -1).reshape(-1, 3)}
    assert found <= {*table.values(), (1, 2, 3), tuple(look.nodata)}
    assert {*table.values()} <= found


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16"])
@pytest.mark.parametrize("how", ["word", "names", "table", "vat"])
@pytest.mark.parametrize("samples", [1, 2])
def test_class_rasters_without_a_colour_table(small: Block, tmp_path: Path, dtype: str, how: str, samples: int) -> None:
    """As many colours as classes, far from each other: stated by a word, category names or an attribute table."""
    numbers = np.array([3, 4, 111, 112] if dtype == "uint8" else [3, 4, 111, 1112], dtype)
    with rasterio.open(small.terrain) as terrain:
        profile = {"crs": terrain.crs, "transform": terrain.transform, "width": terrain.width, "height": terrain.height}
    index = np.random.default_rng(8).integers(0, 4, (1, profile["height"], profile["width"]))
    file = tmp_path / "c.tif"
    with rasterio.open(file, "w", driver="GTiff", count=1, dtype=dtype, **profile) as out:
        out.write(numbers[index])
    aux = {
        "names": "<CategoryNames><Category>none</Category><Category>wood</Category></CategoryNames>",
        "table": '<GDALRasterAttributeTable tableType="thematic"><FieldDefn index="0"><Name>Value</Name><Type>0</Type>'
        "<Usage>5</Usage></FieldDefn></GDALRasterAttributeTable>",
    }
    if how in aux:
        band = f'<PAMRasterBand band="1">{aux[how]}</PAMRasterBand>'
        file.with_name("c.tif.aux.xml").write_text(f"<PAMDataset>{band}</PAMDataset>")
    elif how == "vat":
        file.with_name("c.tif.vat.dbf").write_bytes(b"")
    content = ContentRequest.parse(f"{file}@classes" if how == "word" else str(file))
    look = LookRequest(contents=(content,), samples=samples, sky=(1, 2, 3))
    _, picture = made(ViewRequest(small.terrain, STAND, output=tmp_path / "v.tif", look=look))
    found = {tuple(map(int, colour)) for colour in np.moveaxis(picture[:3], 0, -1).reshape(-1, 3)}
    colours = np.array(sorted(found - {(1, 2, 3), tuple(look.nodata)}))
    assert len(colours) == len(numbers)
    apart = np.abs(colours[:, None] - colours).max(axis=-1)
    assert apart[~np.eye(4, dtype=bool)].min() > 20


def test_grey_values_are_no_classes_unless_it_is_said(small: Block, tmp_path: Path) -> None:
    """Of whole numbers without names the values are mixed; classes of several bands or fractions are refused."""
    assert ContentRequest.parse(f"{small.terrain}@0.5@classes") == ContentRequest.parse(f"{small.terrain}@classes@0.5")
    with pytest.raises(UsageError, match="only the file of a raster has classes"):
        ContentRequest.parse("tint@classes")
    look = LookRequest(contents=(ContentRequest.parse(f"{small.terrain}@classes"),))
    with pytest.raises(UsageError, match="classes are whole numbers in one band"):
        made(ViewRequest(small.terrain, STAND, output=tmp_path / "v.tif", look=look))
    numbers = np.arange(256)
    colours = class_colours(numbers[None])[:, 0].T
    assert len({tuple(c) for c in colours.tolist()}) == 256 and colours.min() >= 0 and colours.max() <= 255


def test_tolerance_0_is_the_strict_way(small: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every pixel is computed strictly; anchors of a tolerance give the same picture to a grey value or so."""
    compiled, residuals, pictures = product.compile_anchors, list[float](), {}

    def noted(*words: Any, **more: Any) -> Any:
        anchors = compiled(*words, **more)
        residuals.extend([] if anchors is None else [anchors.residual])
        return anchors

    monkeypatch.setattr(product, "compile_anchors", noted)
    for tolerance in (0.0, 0.02):
        residuals.clear()
        look = LookRequest(contents=(ContentRequest("photos"),), samples=1, tolerance=tolerance)
        _, picture = made(ViewRequest(small.project, STAND, output=tmp_path / f"{tolerance}.tif", look=look))
        pictures[tolerance] = picture.astype(int)
        assert residuals and (max(residuals) == 0) == (tolerance == 0), residuals
    off = np.abs(pictures[0.0] - pictures[0.02])
    assert off.max() <= 3 and off.mean() < 0.1
    for wrong in (-1.0, 1e-9, 11.0, float("nan")):
        with pytest.raises(UsageError, match="must be 0"):
            LookRequest(tolerance=wrong)
    said = inside("view", small.project, "--from", X0, Y0, "--tolerance", -1, "-o", tmp_path / "v.png")
    assert said.code == 2 and "must be 0" in said.err
