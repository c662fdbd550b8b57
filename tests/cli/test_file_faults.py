"""Files and names that cannot be used: exit code 3, the file and what to do are named, nothing is made."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import rasterio
from tools.command import OPTIONS, Here, edit, refused
from tools.effort import at_most
from tools.small_block import Block, texture, write_image


class TestFaults01And02Heights:
    def test_fault_01_the_grid_of_a_geoid_is_missing(
        self, photoplan: Here, small: Block, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        edit(small.project, 'height_system = "same"\n\n[or', 'height_system = "EPSG:3855"\n\n[or')
        edit(small.project, 'height_system = "same"  #', 'height_system = "ellipsoidal"  #')
        said = refused(photoplan, small.project)
        assert "us_nga_egm08_25.tif" in said
        assert "is not installed; get it with `pyproj sync" in said

    def test_fault_01_at_init_too(self, photoplan: Here, small: Block) -> None:
        small.project.unlink()
        systems = ["--terrain-height-system", "EPSG:3855", "--orientation-height-system", "ellipsoidal"]
        said = photoplan("init", small.folder, *small.init_options(), *systems)
        if said.code == 0:
            assert "us_nga_egm08_25.tif" in refused(photoplan, small.project)
        else:
            assert said.code == 3
            assert "us_nga_egm08_25.tif" in said.err

    def test_fault_02_undeclared_height_systems(self, photoplan: Here, small: Block) -> None:
        small.project.unlink()
        said = photoplan("init", small.folder, *small.init_options())
        assert (said.code, said.out) == (3, "")
        assert "3 images" in said.err
        assert "terrain not stated, orientation not stated" in said.err
        assert "--height-system same" in said.err
        assert "ellipsoidal, EPSG:nnnn" in said.err
        assert not small.project.exists()

    def test_fault_02_a_declaration_that_is_taken_out_again(self, photoplan: Here, small: Block) -> None:
        edit(small.project, 'height_system = "same"\n\n[or', "\n[or")
        edit(small.project, 'height_system = "same"  #', "#")
        assert "declare one" in refused(photoplan, small.project)

    def test_fault_02_the_declaration_is_recorded(self, photoplan: Here, small: Block) -> None:
        assert photoplan("ortho", small.project, *OPTIONS, "--images", "one").code == 0
        record = photoplan("info", small.folder / "products" / "one_ortho.run.json").out
        assert "terrain: same" in record
        assert "orientation: same" in record


class TestFaults07To09Files:
    def test_fault_07_a_bomb_is_refused_from_its_header(self, photoplan: Here, small: Block) -> None:
        photoplan("check", small.project)  # what is loaded once does not count
        bomb = small.images[0]
        bomb.unlink()
        side = 400_000
        profile = {"driver": "GTiff", "width": side, "height": side, "count": 3, "dtype": "uint8", "SPARSE_OK": True}
        with rasterio.open(bomb, "w", tiled=True, blockxsize=4096, blockysize=4096, bigtiff="YES", **profile):
            pass
        with at_most(1):
            said = photoplan("ortho", small.project, *OPTIONS, "--images", "one")
        assert said.code == 3
        assert f"{bomb}: the header promises 400000 × 400000 pixels" in said.err

    def test_fault_08_truncated(self, photoplan: Here, small: Block) -> None:
        image = small.images[0]
        image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
        said = photoplan("ortho", small.project, *OPTIONS, "--images", "one")
        assert said.code == 3
        assert str(image) in said.err
        assert "Get a fresh copy" in said.err

    def test_fault_08_flipped_bits_in_one_block(self, photoplan: Here, small: Block) -> None:
        """File, band and window are named; tiles that do not need the block are kept."""
        image = write_image(
            small.images[0], texture(), tiled=True, blockxsize=64, blockysize=64, compress="deflate", interleave="band"
        )
        content = bytearray(image.read_bytes())
        with rasterio.open(image) as file:
            offset = int(file.get_tag_item("BLOCK_OFFSET_2_1", "TIFF", bidx=2))
        content[offset : offset + 8] = b"\xff" * 8
        image.write_bytes(content)
        said = photoplan("ortho", small.project, *OPTIONS, "--workers", 1, "--images", "one")
        assert said.code == 3
        assert f"{image}: band 2, window col " in said.err
        assert "the pixels cannot be read" in said.err
        folder = small.folder / "products"
        assert not (folder / "one_ortho.tif").exists()
        assert (folder / ".one_ortho.tif.tiles").stat().st_size > 128 * 128 * 3

    @pytest.mark.parametrize(
        ("file", "message"),
        [
            ("/vsicurl/http://127.0.0.1:9/a.tif", "virtual file systems are not read"),
            ("http://127.0.0.1:9/a.tif", "addresses and driver prefixes are not read"),
            ("GTIFF_DIR:1:images/one.tif", "addresses and driver prefixes are not read"),
        ],
    )
    def test_fault_09_remote_and_virtual_names(self, photoplan: Here, small: Block, file: str, message: str) -> None:
        edit(small.project, '"images/one.tif"', f'"{file}"')
        said = refused(photoplan, small.project)
        assert file in said
        assert message in said

    @pytest.mark.parametrize("which", ["image", "terrain"])
    def test_fault_09_a_virtual_raster_under_an_innocent_name(
        self, photoplan: Here, small: Block, tmp_path: Path, which: str
    ) -> None:
        path = small.images[0] if which == "image" else small.terrain
        secret = Path(shutil.copy(path, tmp_path / "secret.tif"))
        path.write_text(
            f'<VRTDataset rasterXSize="200" rasterYSize="150"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
            f"<SourceFilename>{secret}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
        )
        said = refused(photoplan, small.project, image="one")
        assert str(path) in said
        assert "it is not followed" in said


class TestFaults11And12Names:
    @pytest.mark.parametrize(
        ("name", "product"),
        [
            ("../../x", "x_ortho.tif"),
            pytest.param("/etc/passwd", "passwd_ortho.tif", marks=pytest.mark.slow),
            pytest.param("..\\\\..\\\\x", "x_ortho.tif", marks=pytest.mark.slow),
            pytest.param("CON", "CON__ortho.tif", marks=pytest.mark.slow),
            ("Büro 第一", "Büro_第一_ortho.tif"),
            pytest.param("a:b*c?", "a_b_c__ortho.tif", marks=pytest.mark.slow),
            pytest.param("-rf", "rf_ortho.tif", marks=pytest.mark.slow),
            ("n" * 300, None),
        ],
    )
    def test_fault_11_names_stay_inside(
        self, photoplan: Here, small: Block, tmp_path: Path, name: str, product: str | None
    ) -> None:
        """Whatever an image is called: its product lies in the output folder, and nothing anywhere else."""
        edit(small.project, 'name = "one"', f'name = "{name}"')
        before = {p for p in tmp_path.rglob("*") if "products" not in p.parts}
        said = photoplan("ortho", small.project, *OPTIONS)
        assert said.code == 0, said.err
        assert {p for p in tmp_path.rglob("*") if "products" not in p.parts} == before
        folder = small.folder / "products"
        made = {p.name for p in folder.glob("*.tif")} - {"two_ortho.tif", "three_ortho.tif"}
        assert len(made) == 1
        assert max(len(n.encode()) for n in made) < 160
        assert product is None or made == {product}
        assert len(list(folder.iterdir())) == 3 + 3 + 1

    @pytest.mark.parametrize("name", ["..", "/", "???", ""])
    def test_fault_11_names_of_nothing_are_refused(self, photoplan: Here, small: Block, name: str) -> None:
        edit(small.project, 'name = "one"', f'name = "{name}"')
        assert "name" in refused(photoplan, small.project)

    def test_fault_11_names_in_a_table(self, photoplan: Here, small: Block, tmp_path: Path) -> None:
        """A table leads to an image by its name only; the project that is made of it stays inside."""
        small.project.unlink()
        edit(small.orientation, "\none,", "\n../images/one.tif,")
        said = photoplan("init", small.folder, *small.init_options(), "--height-system", "same")
        assert said.code == 0, said.err
        assert photoplan("ortho", small.project, *OPTIONS).code == 0
        assert sorted(p.name for p in (small.folder / "products").glob("*.tif")) == [
            "one_ortho.tif", "three_ortho.tif", "two_ortho.tif"
        ]  # fmt: skip

    def test_fault_12_two_images_of_one_name(self, photoplan: Here, small: Block) -> None:
        edit(small.project, 'name = "one"', 'name = "three"')
        assert "'three'" in refused(photoplan, small.project)

    @pytest.mark.parametrize(("other", "stem"), [("THREE", "THREE"), ("x/three", "x_three"), ("three.jpg", "three")])
    def test_fault_12_two_images_with_one_base_name(self, photoplan: Here, small: Block, other: str, stem: str) -> None:
        """Their products have distinct names, also where capitals are not told apart."""
        edit(small.project, 'name = "one"', f'name = "{other}"')
        assert photoplan("ortho", small.project, *OPTIONS).code == 0
        last = "three" if stem == "x_three" else "three_2"
        found = {path.name for path in (small.folder / "products").glob("*_ortho.tif")}
        assert found == {f"{stem}_ortho.tif", f"{last}_ortho.tif", "two_ortho.tif"}

    def test_fault_12_two_files_with_one_base_name(self, photoplan: Here, small: Block) -> None:
        small.project.unlink()
        (small.folder / "more").mkdir()
        shutil.copy(small.images[0], small.folder / "more" / "one.tif")
        more = ["--images", small.folder / "more" / "*.tif"]
        said = photoplan("init", small.folder, *small.init_options(), *more, "--height-system", "same")
        assert said.code == 3
        assert "more/one.tif" in said.err
        assert "images/one.tif" in said.err
        assert not small.project.exists()
