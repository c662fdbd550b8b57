"""Orientations, reference systems and terrain that do not fit together: found, named, and never guessed."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from rasterio.warp import Resampling, calculate_default_transform, reproject
from tools.command import OPTIONS, Here, edit, refused
from tools.small_block import CRS, X0, Y0, Z0, Block, texture, write_image, write_terrain


class TestFaults14And18Tables:
    @staticmethod
    def strip(small: Block, kappas: list[float], unit: float) -> None:
        """Eight images in one line, turned by quarter circles, and their table in another unit than degrees."""
        for path in small.images:
            path.unlink()
        lines = ["name,x,y,z,omega,phi,kappa"]
        for i, kappa in enumerate(kappas):
            write_image(small.folder / "images" / f"i{i}.tif", texture(seed=i))
            lines.append(f"i{i},{X0 - 60 + 30 * i},{Y0},{Z0},{0.4 * unit:.6f},{-0.3 * unit:.6f},{kappa * unit:.6f}")
        small.orientation.write_text("\n".join(lines) + "\n")

    def test_fault_14_gon_declared_as_degrees(self, photoplan: Here, small: Block) -> None:
        self.strip(small, [0, 90, 180, 270, 90, 0, 270, 180], 400 / 360)
        declare = ["--height-system", "same", "--overwrite"]
        assert photoplan("init", small.folder, *small.init_options(), *declare).code == 0
        said = photoplan("check", small.project)
        assert said.code == 3
        assert str(small.project) in said.err
        assert "--angle-unit gon" in said.err
        assert "all plausible" not in said.out
        # What it advises is what helps.
        assert photoplan("init", small.folder, *small.init_options(), *declare, "--angle-unit", "gon").code == 0
        said = photoplan("check", small.project)
        assert said.code == 0
        assert "all plausible" in said.out

    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            ("500360.000000", "5003 60", "orientation.csv:3: "),
            ("500360.000000", "nan", "orientation.csv:3: "),
            (",95.000000", "", "orientation.csv:3: "),
            (",95.000000", ",95,17", "orientation.csv:3: "),
            ("two,", "one,", "one"),
            ("kappa", "kapa", "kappa"),
        ],
        ids=["number", "nan", "short", "long", "twice", "header"],
    )
    def test_fault_18_a_table_with_a_fault(
        self, photoplan: Here, small: Block, old: str, new: str, message: str
    ) -> None:
        small.project.unlink()
        edit(small.orientation, old, new)
        said = photoplan("init", small.folder, *small.init_options(), "--height-system", "same")
        assert (said.code, said.out) == (3, "")
        assert str(small.orientation) in said.err
        assert message in said.err
        assert not small.project.exists()

    def test_fault_18_a_header_only(self, photoplan: Here, small: Block) -> None:
        small.project.unlink()
        small.orientation.write_text("name,x,y,z,omega,phi,kappa\n")
        said = photoplan("init", small.folder, *small.init_options(), "--height-system", "same")
        assert said.code == 3
        assert str(small.orientation) in said.err

    @pytest.mark.parametrize("form", ["bom", "crlf", "semicolon-comma"])
    def test_fault_18_read_as_declared(self, photoplan: Here, small: Block, form: str) -> None:
        """Byte-order mark and CRLF change nothing; a decimal comma is read where it is declared."""
        before = small.project.read_text()
        text = small.orientation.read_text()
        options: list[str] = []
        if form == "semicolon-comma":
            text = text.replace(",", ";").replace(".", ",")
            options = ["--decimal-comma", "--delimiter", "semicolon"]
        elif form == "crlf":
            text = text.replace("\n", "\r\n")
        small.orientation.write_bytes(text.encode("utf-8-sig" if form == "bom" else "utf-8"))
        words = [*small.init_options(), "--height-system", "same", "--overwrite", *options]
        assert photoplan("init", small.folder, *words).code == 0
        assert small.project.read_text() == before


class TestFaults20And21Places:
    @pytest.mark.parametrize(
        ("crs", "message"),
        [(None, "no CRS"), ("EPSG:4326", ""), ("EPSG:2263", "")],
        ids=["none", "geographic", "feet"],
    )
    def test_fault_20_the_terrains_crs(self, photoplan: Here, small: Block, crs: str | None, message: str) -> None:
        """Without a CRS it is refused, never guessed; another one is converted, and metres of degrees lie elsewhere."""
        write_terrain(small.terrain, crs=crs)
        said = refused(photoplan, small.project)
        assert message in said

    @pytest.mark.parametrize(
        ("crs", "message"), [("EPSG:4326", "geographic"), ("EPSG:2263", "foot"), ("EPSG:1", "EPSG:1")]
    )
    def test_fault_20_the_projects_crs(self, photoplan: Here, small: Block, crs: str, message: str) -> None:
        edit(small.project, f'crs = "{CRS}"', f'crs = "{crs}"')
        said = refused(photoplan, small.project)
        assert f"{small.project}: crs: " in said
        assert message in said

    def test_fault_20_heights_in_an_unknown_unit(self, photoplan: Here, small: Block) -> None:
        with rasterio.open(small.terrain, "r+") as file:
            file.units = ["cubits"]
        said = refused(photoplan, small.project)
        assert str(small.terrain) in said
        assert "'cubits' is not a known unit of length" in said

    def test_fault_20_a_terrain_in_another_crs_is_converted(self, photoplan: Here, small: Block) -> None:
        """The same hills in the neighbouring zone give the same product within the DEM's own interpolation."""
        assert photoplan("ortho", small.project, *OPTIONS, "--images", "one").code == 0
        first = small.folder / "products" / "one_ortho.tif"
        with rasterio.open(first) as file:
            bounds = [str(b) for b in file.bounds]
        words = ["ortho", small.project, *OPTIONS, "--images", "one", "--overwrite", "--bounds", *bounds]
        assert photoplan(*words).code == 0
        with rasterio.open(first) as file:
            before = file.read().astype(int)
        with rasterio.open(small.terrain) as file:
            to, width, height = calculate_default_transform(file.crs, "EPSG:32632", *file.shape[::-1], *file.bounds)
            there = np.full((height, width), np.nan, np.float32)
            reproject(
                file.read(1), there, src_transform=file.transform, src_crs=file.crs, dst_transform=to,
                dst_crs="EPSG:32632", resampling=Resampling.bilinear, dst_nodata=np.nan,
            )  # fmt: skip
        write_image(small.terrain, there[None], crs="EPSG:32632", transform=to, nodata=np.nan)
        assert photoplan(*words).code == 0
        with rasterio.open(first) as file:
            after = file.read().astype(int)
        seen = (before > 0).all(axis=0) & (after > 0).all(axis=0)
        assert seen.mean() > 0.7
        assert np.percentile(np.abs(after - before)[:, seen], 99) <= 8

    def test_fault_21_no_overlap(self, photoplan: Here, small: Block) -> None:
        """Extents of both are printed."""
        with rasterio.open(small.terrain) as file:
            heights = file.read(1)
        write_terrain(small.terrain, heights, transform=from_origin(X0 + 5000, Y0 + 300, 10, 10))
        said = refused(photoplan, small.project)
        # The image is turned by 3° and tilted a little, so its 300 m × 225 m have bounds of some 315 m × 245 m.
        looks = re.search(r"one: projection centre 500300 5300200 400 looks at (\d+) (\d+) (\d+) (\d+) on", said)
        assert looks is not None
        assert np.abs(np.array(looks.groups(), int) - (X0 - 150, Y0 - 115, X0 + 165, Y0 + 130)).max() <= 5
        assert "the terrain is 505300 5299900 505940 5300500\n" in said

    def test_fault_21_a_part_of_the_images_sees_terrain(self, photoplan: Here, small: Block) -> None:
        """The others are left out and named; theirs is no product."""
        edit(small.project, "center = [500360.0, 5300200.0, 400.0]", "center = [520360.0, 5300200.0, 400.0]")
        said = photoplan("ortho", small.project, *OPTIONS)
        assert said.code == 0
        assert "left out: two: projection centre 520360" in said.err
        assert sorted(p.name for p in small.folder.glob("products/*.tif")) == ["one_ortho.tif", "three_ortho.tif"]

    def test_fault_21_holes_in_the_terrain_stay_nodata(self, photoplan: Here, small: Block) -> None:
        """Product pixels over a hole are nodata, all others are what they were, and the share says so."""
        words = ["ortho", small.project, *OPTIONS, "--images", "one", "--json"]
        words += ["--bounds", X0 - 60, Y0 - 60, X0 + 60, Y0 + 60]
        folder = small.folder / "products"
        whole = json.loads(photoplan(*words).out)["products"][0]
        assert whole["valid_share"] == 1
        with rasterio.open(folder / "one_ortho.tif") as file:
            before = file.read()
        with rasterio.open(small.terrain) as file:
            heights = file.read(1)
        # Posts of 10 m from X0 - 255: columns 26 to 28 are X0 + 5 to X0 + 25; rows 26 to 28 are Y0 + 35 to Y0 + 15.
        heights[26:29, 26:29] = -9999
        write_terrain(small.terrain, heights, nodata=-9999)
        holed = json.loads(photoplan(*words, "--overwrite").out)["products"][0]
        with rasterio.open(folder / "one_ortho.tif") as file:
            after, valid = file.read(), file.dataset_mask() > 0
        row, col = np.nonzero(~valid)
        # No mesh with a hole at a corner has heights: X0 - 5 to X0 + 35, and Y0 + 5 to Y0 + 45.
        assert (col.min(), col.max()) == (55, 94)
        assert (row.min(), row.max()) == (15, 54)
        assert len(row) == 40 * 40
        assert holed["valid_share"] == pytest.approx(1 - 40 * 40 / 120**2, abs=1e-6)
        assert (after[:, ~valid] == 0).all()
        np.testing.assert_array_equal(after[:, valid], before[:, valid])

    def test_fault_21_a_camera_below_the_terrain(self, photoplan: Here, small: Block) -> None:
        text = small.project.read_text().replace(", 400.0]", ", 40.0]")
        small.project.write_text(text)
        said = refused(photoplan, small.project)
        assert "projection centre 500300 5300200 40" in said
        said = photoplan("check", small.project).err
        assert "m below the terrain; are the height systems the same?" in said

    @pytest.mark.parametrize("omega", [90.0, 80.0, 120.0])
    def test_fault_21_a_horizontal_view(self, photoplan: Here, small: Block, omega: float) -> None:
        """Terrain below the horizon is taken, the sky is not, and nothing behind the camera appears."""
        edit(small.project, "angles = [0.8, -1.2, 3.0]", f"angles = [{omega}, 0.0, 0.0]")
        edit(small.project, "center = [500300.0, 5300200.0, 400.0]", f"center = [{X0}, {Y0 - 100}, 130.0]")
        said = photoplan("ortho", small.project, *OPTIONS, "--images", "one")
        if omega == 120.0:
            # The field of view is 41° high: 30° above the horizon only the sky is seen.
            assert said.code == 3
            assert "one: projection centre 500300 5300100 130 does not look down" in said.err
            return
        assert said.code == 0, said.err
        with rasterio.open(small.folder / "products" / "one_ortho.tif") as file:
            rows, _ = np.nonzero(file.dataset_mask())
            nearest = file.bounds.top - rows.max() - 0.5
        # The lowest ray leaves at 20.6° below the axis; 18 to 38 m below the camera is ground.
        low = 90 - omega + math.degrees(math.atan(75 / 200))
        assert Y0 - 100 + 18 / math.tan(math.radians(low)) < nearest < Y0 - 100 + 40 / math.tan(math.radians(low))
