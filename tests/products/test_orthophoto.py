"""Orthophotos as a whole: position on the map, crops, constants, and what a plan says of itself."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.enums
from numpy.typing import NDArray
from tools.command import inside
from tools.kinds import FEW
from tools.kinds import NAMES as KERNELS
from tools.small_block import FOCAL, NAMES, SIZE, X0, Y0, YAML, Z0, Block, make_project, write_image, write_terrain
from tools.thinned import some

import photoplan as pp
from photoplan.cameras.base import project
from photoplan.errors import GeometryError, UsageError
from photoplan.io.project.file import load_project
from photoplan.plan.footprint import mean_gsd
from photoplan.products.orthophoto.execution import Run, execute
from photoplan.products.orthophoto.plan import plan_orthophotos, render, two_figures
from photoplan.project.scene import open_scene
from photoplan.surfaces.shifted import intersect

QUIET = Run(quicklook=False)


def alone(small: Block, pixels: NDArray[np.generic], angles: tuple[float, float, float], lens: str = "") -> Block:
    """The block with one image only, of these pixels and angles in degrees."""
    for other in small.images[1:]:
        other.unlink(missing_ok=True)
    write_image(small.images[0], pixels)
    numbers = ",".join(map(str, (X0, Y0, Z0, *angles)))
    small.orientation.write_text(f"name,x,y,z,omega,phi,kappa\none,{numbers}\n")
    if lens:
        small.camera.write_text(YAML.replace("pinhole", "opencv") + lens)
    make_project(small)
    return small


def made(small: Block, **settings: object) -> tuple[Path, NDArray[np.generic], NDArray[np.bool_]]:
    """The first image's product: file, pixels, validity."""
    plan = plan_orthophotos(load_project(small.project), ["one"], **settings)
    path = execute(plan, small.folder / "products", Run(quicklook=False, overwrite=True))[0].path
    with rasterio.open(path) as file:
        return path, file.read(), file.dataset_mask() > 0


class TestPosition:
    """A scene that is painted with its own coordinates tells where each product pixel came from."""

    @pytest.mark.parametrize(
        ("kappa", "kernel"), some([*itertools.product((0.0, 37.0), ("bilinear", "bicubic", "lanczos3"))], 0, 4)
    )
    def test_level_scene_to_float_precision(self, small: Block, kernel: str, kappa: float) -> None:
        """A vertical image of level ground: X and Y are linear in the image, and linear kernels reproduce them."""
        level = 100.0
        write_terrain(small.terrain, np.full((60, 64), level))
        x = np.arange(SIZE[0]) - (SIZE[0] - 1) / 2
        y = (SIZE[1] - 1) / 2 - np.arange(SIZE[1])
        x, y = (a * (Z0 - level) / FOCAL for a in np.meshgrid(x, y))
        k = np.radians(kappa)
        east, north = np.cos(k) * x - np.sin(k) * y, np.sin(k) * x + np.cos(k) * y
        alone(small, np.stack([east, north]).astype(np.float32), (0, 0, kappa))
        path, pixels, valid = made(small, resolution=0.7, kernel=kernel, tile=128)
        with rasterio.open(path) as file:
            to_map = file.transform
        # The grid lies on whole multiples of the resolution, exactly.
        for number in (to_map.c, to_map.f):
            assert abs(number / 0.7 - round(number / 0.7)) * 0.7 < 1e-6
        assert (to_map.a, to_map.b, to_map.d, to_map.e) == (0.7, 0, 0, -0.7)
        row, col = np.nonzero(valid)
        # Lanczos does not keep linear functions: it is out by up to 0.02 pixels of 1.5 m in x and in y.
        slack = {"lanczos3": 0.05}.get(kernel, 1e-4)
        inner = (np.abs(pixels[0]) < 90) & (np.abs(pixels[1]) < 60)
        keep = inner[row, col]
        X, Y = to_map.c + (col + 0.5) * to_map.a, to_map.f + (row + 0.5) * to_map.e
        assert keep.sum() > 20_000
        np.testing.assert_allclose(pixels[0][row, col][keep], (X - X0)[keep], atol=slack)
        np.testing.assert_allclose(pixels[1][row, col][keep], (Y - Y0)[keep], atol=slack)

    @pytest.mark.parametrize("lens", ["", "  k1: -0.12\n  k2: 0.03\n  p1: 0.001\n"])
    def test_tilted_image_of_hills(self, small: Block, lens: str) -> None:
        """With relief, tilt and a lens: each pixel centre is where its own coordinates say, to a fiftieth of one."""
        angles = (4.0, -3.0, 71.0)
        alone(small, np.zeros((3, SIZE[1], SIZE[0]), np.float32), angles, lens)
        scene = open_scene(load_project(small.project), "one")
        x, y = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
        ground = intersect(scene.camera, np.stack([x.ravel(), y.ravel()], axis=1), scene.surface, (85, 115))
        ground = ground.reshape(SIZE[1], SIZE[0], 3) - (X0, Y0, 0)
        alone(small, np.moveaxis(ground, -1, 0).astype(np.float32), angles, lens)
        path, pixels, valid = made(small, resolution=1.3, kernel="bicubic", tile=128)
        with rasterio.open(path) as file:
            to_map = file.transform
        row, col = np.nonzero(valid)
        error = np.stack(
            [
                pixels[0][row, col].astype(float) + X0 - (to_map.c + (col + 0.5) * 1.3),
                pixels[1][row, col].astype(float) + Y0 - (to_map.f - (row + 0.5) * 1.3),
            ]
        )
        assert valid.mean() > 0.5
        XY = np.stack([to_map.c + (col + 0.5) * 1.3, to_map.f - (row + 0.5) * 1.3], axis=1)
        height = scene.surface.heights(XY)
        xy = project(scene.camera, np.column_stack([XY, height]))
        # At the image's border the kernel repeats pixels.
        inner = (xy > 2).all(axis=1) & (xy < np.array(SIZE) - 3).all(axis=1)
        assert inner.mean() > 0.9
        # The anchors' tolerance is 0.02 px of 1.5 m; the rest is the bend of the hills between image pixels.
        assert np.abs(np.median(error[:, inner], axis=1)).max() < 0.002
        assert np.percentile(np.abs(error[:, inner]), 99) < 0.03
        # Heights as the terrain has them below each pixel.
        assert np.percentile(np.abs(pixels[2][row, col] - height)[inner], 99) < 0.03


VALUES = {"uint8": 77, "uint16": 40_001, "int16": -1234, "float32": 0.1}


@pytest.mark.parametrize(
    ("dtype", "kernel"),
    [
        pytest.param(dtype, kernel, marks=[] if (kernel, dtype) in FEW else pytest.mark.slow)
        for dtype in VALUES
        for kernel in KERNELS
    ],
)
@pytest.mark.parametrize("resolution", some([0.9, 4.0], 0))
def test_a_constant_image_stays_constant(small: Block, dtype: str, kernel: str, resolution: float) -> None:
    value = VALUES[dtype]
    alone(small, np.full((2, SIZE[1], SIZE[0]), value, dtype), (2, 1, 20), "  k1: -0.1\n")
    _, pixels, valid = made(small, resolution=resolution, kernel=kernel, nodata="mask")
    assert valid.mean() > 0.5
    expected = np.array(value, dtype)
    if dtype == "float32":
        np.testing.assert_allclose(pixels[:, valid], expected, rtol=3e-7)
    else:
        assert (pixels[:, valid] == expected).all()


@pytest.mark.parametrize("lens", ["", "  k1: -0.12\n  k2: 0.03\n"], ids=["pinhole", "distorted"])
class TestCrops:
    @staticmethod
    def whole_and_part(small: Block, lens: str, bounds: tuple[float, float, float, float]) -> tuple:  # type: ignore[type-arg]
        if lens:
            small.camera.write_text(small.camera.read_text().replace("pinhole", "opencv") + lens)
            make_project(small)
        path, whole, whole_valid = made(small, resolution=1.0, tile=128)
        with rasterio.open(path) as file:
            left, top = file.bounds.left, file.bounds.top
        place = (left + bounds[0], top - bounds[3], left + bounds[2], top - bounds[1])
        path, part, part_valid = made(small, resolution=1.0, tile=128, bounds=place)
        with rasterio.open(path) as file:
            assert tuple(file.bounds) == place
        at = np.s_[..., int(bounds[1]) : int(bounds[3]), int(bounds[0]) : int(bounds[2])]
        return whole[at], whole_valid[at], part, part_valid

    def test_identical_where_tiles_align(self, small: Block, lens: str) -> None:
        whole, whole_valid, part, part_valid = self.whole_and_part(small, lens, (128, 0, 256, 128))
        assert part_valid.mean() > 0.5
        np.testing.assert_array_equal(part_valid, whole_valid)
        np.testing.assert_array_equal(part, whole)

    def test_within_a_grey_level_elsewhere(self, small: Block, lens: str) -> None:
        whole, whole_valid, part, part_valid = self.whole_and_part(small, lens, (37, 51, 219, 190))
        assert part_valid.mean() > 0.8
        assert np.count_nonzero(part_valid != whole_valid) <= 3
        both = part_valid & whole_valid
        assert np.abs(part.astype(int) - whole.astype(int))[:, both].max() <= 1


class TestPlan:
    def test_a_plan_says_what_will_be_made(self, pristine: Block) -> None:
        plan = plan_orthophotos(load_project(pristine.project), resolution=1.0, tile=128)
        assert [p.images[0] for p in plan.products] == sorted(NAMES)
        text = str(plan)
        for product in plan.products:
            assert f"{product.plan.name}: {product.grid.width} × {product.grid.height} px of 1 m" in text
        assert plan["one"] is plan["one_ortho"] is plan.products[0]
        with pytest.raises(KeyError, match="the plan has one_ortho, three_ortho, two_ortho"):
            plan["four"]

    def test_resolution_is_the_mean_gsd_to_two_figures(self, small: Block) -> None:
        write_terrain(small.terrain, np.full((60, 64), 100.0))
        alone(small, np.zeros((1, SIZE[1], SIZE[0]), np.uint8), (0, 0, 15))
        project = load_project(small.project)
        scene = open_scene(project, "one")
        gsd = mean_gsd(scene.camera, scene.footprint)
        assert gsd == pytest.approx((Z0 - 100) / FOCAL, rel=1e-9)
        assert plan_orthophotos(project).settings.resolution == 1.5

    @pytest.mark.parametrize(("value", "figures"), [(0.0334, 0.033), (1.55, 1.6), (149.6, 150.0), (0.0995, 0.1)])
    def test_two_figures(self, value: float, figures: float) -> None:
        assert two_figures(value) == pytest.approx(figures, rel=1e-12)

    def test_the_project_file_sets_defaults_and_arguments_override(self, small: Block) -> None:
        text = small.project.read_text()
        for entry, value in (("resolution", "2.5"), ("kernel", '"nearest"'), ("compress", '"lzw"')):
            assert f"# {entry} =" in text
            text = text.replace(f"# {entry} =", f"{entry} = {value} #", 1)
        small.project.write_text(text)
        settings = plan_orthophotos(load_project(small.project), kernel="lanczos3").settings
        assert (settings.resolution, settings.kernel, settings.compress) == (2.5, "lanczos3", "lzw")

    def test_the_key_knows_what_changes_pixels(self, small: Block) -> None:
        """Kernel, resolution, tolerance and inputs make another product; the file's compression and workers do not."""
        project = load_project(small.project)

        def key(**settings: object) -> str:
            return plan_orthophotos(project, ["one"], **{"resolution": 1.0, **settings})["one"].key  # type: ignore[arg-type]

        # Both bicubic kernels take the same pixels: nothing but their name tells them apart.
        others = [key(kernel="bicubic-1"), key(resolution=1.1), key(tolerance=0.1), key(nodata="mask")]
        assert len({key(), *others}) == 5
        assert key(compress="lzw") == key(overviews=False) == key()
        before = key()
        write_terrain(small.terrain, np.full((60, 64), 100.0))
        assert key() != before

    def test_fault_12_names_that_differ_in_capitals_only(self, small: Block) -> None:
        """Two products must not replace one another on file systems that do not tell capitals."""
        project = load_project(small.project)
        images = tuple(image.model_copy(update={"name": name}) for image, name in zip(project.images, ("Ä", "ä", "b")))
        plan = plan_orthophotos(project.model_copy(update={"images": images}))
        assert [each.plan.name for each in plan.products] == ["Ä_ortho", "ä_2_ortho", "b_ortho"]

    def test_unknown_settings_are_named(self, pristine: Block) -> None:
        with pytest.raises(UsageError, match="unknown settings colour; known are accuracy, bounds, choice, compress"):
            plan_orthophotos(load_project(pristine.project), colour="red")

    def test_fault_21_nothing_seen(self, small: Block) -> None:
        project = load_project(small.project)
        images = tuple(i.model_copy(update={"center": (X0, Y0 + 5000, Z0)}) for i in project.images)
        with pytest.raises(
            GeometryError, match=r"one: projection centre 500300 5305200 400 looks at .* the terrain is"
        ):
            plan_orthophotos(project.model_copy(update={"images": images}))


class TestRender:
    def test_the_array_is_the_file(self, small: Block) -> None:
        plan = plan_orthophotos(load_project(small.project), ["one"], resolution=1.0, tile=128)
        values, valid = render(plan, "one")
        _, pixels, mask = made(small, resolution=1.0, tile=128)
        np.testing.assert_array_equal(valid, mask)
        np.testing.assert_array_equal(values, pixels)

    def test_a_part_is_a_part_of_the_whole(self, pristine: Block) -> None:
        """Also across tiles, and where the bounds reach beyond the product."""
        plan = plan_orthophotos(load_project(pristine.project), ["one"], resolution=1.0, tile=128)
        values, valid = render(plan, "one")
        xmin, _, _, ymax = plan["one"].grid.bounds
        part, part_valid = render(plan, "one", (xmin + 100.2, ymax - 150.0, xmin + 200.0, ymax - 20.5))
        np.testing.assert_array_equal(part, values[:, 20:150, 100:200])
        np.testing.assert_array_equal(part_valid, valid[20:150, 100:200])
        corner, _ = render(plan, "one", (xmin - 50, ymax - 30, xmin + 40, ymax + 50))
        np.testing.assert_array_equal(corner, values[:, :30, :40])
        nothing, _ = render(plan, "one", (xmin - 50, ymax + 30, xmin - 40, ymax + 50))
        assert nothing.size == 0


def test_bands_keep_their_names_and_colours(small: Block) -> None:
    pixels = np.random.default_rng(1).integers(1, 255, (4, SIZE[1], SIZE[0])).astype(np.uint8)
    alone(small, pixels, (0, 0, 0))
    colours = [rasterio.enums.ColorInterp[name] for name in ("blue", "green", "red", "undefined")]
    with rasterio.open(small.images[0], "r+") as file:
        file.descriptions = ("B", "G", "R", "near infrared")
        file.colorinterp = colours
    path, _, _ = made(small, resolution=2.0)
    with rasterio.open(path) as file:
        assert file.descriptions == ("B", "G", "R", "near infrared")
        assert list(file.colorinterp) == colours


def test_options_that_are_not_set_are_those_of_the_project(small: Block) -> None:
    """Also on the command line, where an option may be given its usual value."""
    text = small.project.read_text()
    small.project.write_text(text.replace("\n[ortho]\n", '\n[ortho]\nkernel = "nearest"\nresolution = 3.0\n'))
    for given, kernel in (({}, "nearest"), ({"kernel": "bicubic"}, "bicubic")):
        plan = pp.make_products(pp.OrthoRequest(small.project, dry_run=True, **given)).plan
        assert (plan.settings.kernel, plan.settings.resolution) == (kernel, 3.0)
        words = [word for name, value in given.items() for word in (f"--{name}", value)]
        assert f"kernel {kernel}" in inside("ortho", small.project, "--dry-run", *words).out
    request = pp.OrthoRequest(small.project, images=("one",), output=small.folder / "made", quicklook=False)
    (path, *_) = pp.make_products(request).written()
    assert path == small.folder / "made" / "one_ortho.tif" and path.is_file()
    with pytest.raises(UsageError, match="exists"):
        pp.make_products(request)
