"""Faults 10, 11, 13, 14, 16, 17, 18, 25 and 29 with inputs of orientation, through the commands that users call."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from tools.adjust_project import Make, write_project
from tools.command import Here, Said, edit, inside, start, wait_for
from tools.thinned import some

import photoplan as photoplan_package
from photoplan.products.adjust import run as adjust

pytest.importorskip("matplotlib")

SKIP_ROOT = pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
POSITIONS = 'positions = "positions.csv"\nsigma_position = [0.05, 0.05]\n'
CONTROL = 'control = ["control.csv"]\nsigma_control = [0.01, 0.01]\n'


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight images, nine ground points of which three are check points, observed positions."""
    return write_project(
        tmp_path_factory.mktemp("faults") / "block", Make(pixel_noise=0.3, check=3, positions=True)
    ).path


@pytest.fixture
def block(original: Path, tmp_path: Path) -> Path:
    """The folder of a copy to spoil."""
    return Path(shutil.copytree(original.parent, tmp_path / "block"))


def lines(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the lines of a table."""
    path.write_text("\n".join(change(path.read_text().strip().split("\n"))) + "\n")


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused(photoplan: Here, block: Path, verb: str, *words: object, code: int = 3) -> str:
    """What a command says that refuses its work; nothing in the folder has changed."""
    before = state(block)
    said = photoplan(verb, block / "project.toml", *words)
    assert said.code == code, said
    assert said.out == ""
    assert state(block) == before
    assert "Warning" not in said.err, said.err
    return said.err


def no_nan(said: Said, folder: Path) -> None:
    """Neither what was printed nor a file that was written holds NaN."""
    assert said.code == 0, said.err
    words = said.out.replace("\n", " ").replace(",", " ").lower().split()
    assert not {"nan", "+nan", "-nan", "inf", "+inf", "-inf"} & set(words)
    written = [p for p in folder.rglob("*") if p.suffix in (".json", ".csv", ".toml")]
    assert written
    for path in written:
        fields = path.read_text().lower().replace(",", " ").replace("[", " ").replace("]", " ").split()
        assert not {"nan", "+nan", "-nan", "inf", "-inf", "infinity"} & set(fields), path


class TestXml:
    DOCUMENT = '<document version="2.0.0"><chunk label="c"><sensors/><cameras>&{name};</cameras></chunk></document>'
    BOMB = '<!DOCTYPE d [<!ENTITY a0 "aaaaaaaaaa">{}]>'.format(
        "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(9))
    )

    def test_fault_10_bombs_and_external_entities_in_metashape_files(self, photoplan: Here, tmp_path: Path) -> None:
        secret = tmp_path / "secret.txt"
        secret.write_text("the secret")
        for prolog, name in (
            (self.BOMB, "a9"),
            (f'<!DOCTYPE d [<!ENTITY x SYSTEM "{secret.as_uri()}">]>', "x"),
            ('<!DOCTYPE d SYSTEM "http://127.0.0.1:9/evil.dtd">', "amp"),
        ):
            path = tmp_path / "cameras.xml"
            path.write_text(prolog + self.DOCUMENT.format(name=name))
            said = photoplan("convert", path, "--to", "csv", "--crs", "EPSG:25832")
            assert said.code == 3, said
            assert "cameras.xml: holds a document type or entities" in said.err
            assert "secret" not in said.out + said.err.replace(str(tmp_path), "")
        assert sorted(p.name for p in tmp_path.iterdir()) == ["cameras.xml", "secret.txt"]

    def test_fault_10_in_the_xmp_of_images(self, photoplan: Here, tmp_path: Path) -> None:
        folder = tmp_path / "images"
        folder.mkdir()
        packet = b"http://ns.adobe.com/xap/1.0/\0" + (self.BOMB + "<x>&a9;</x>").encode()
        segment = b"\xff\xe1" + (len(packet) + 2).to_bytes(2, "big") + packet
        (folder / "a.jpg").write_bytes(b"\xff\xd8" + segment + b"\xff\xd9")
        said = photoplan("convert", folder, "--to", "csv", "--crs", "EPSG:25832")
        assert said.code == 3, said
        assert "a.jpg" in said.err and "document type or entities" in said.err


class TestNames:
    HOSTILE = ("../../evil", "/tmp/evil", "..\\..\\evil", "x" * 900, "CON", "=1+1", "<script>alert(1)</script>")

    def test_fault_11_of_points_do_no_harm(self, photoplan: Here, block: Path, tmp_path: Path) -> None:
        """They are names: kept in the tables, escaped in the report, never part of a path."""
        for k, hostile in enumerate(self.HOSTILE):
            for table in ("points.csv", "control.csv"):
                edit_first = (block / table).read_text().replace(f"G{k + 1},", f'"{hostile}",')
                (block / table).write_text(edit_first)
        outside = state(tmp_path)
        said = photoplan("adjust", block / "project.toml")
        assert said.code == 0, said.err
        new = set(state(tmp_path)) - set(outside)
        assert {Path(p).parts[:2] for p in new} <= {("block", "adjustment"), ("block", "project.previous.toml")}
        assert "<script>alert" not in (block / "adjustment" / "report.html").read_text()
        found = json.loads((block / "adjustment" / "report.json").read_text())
        assert {"../../evil", "x" * 900} <= {c["name"] for c in found["control"]}

    @pytest.mark.parametrize("table", ["points.csv", "control.csv", "positions.csv"])
    def test_fault_11_zero_bytes_and_endless_names(self, photoplan: Here, block: Path, table: str) -> None:
        text = (block / table).read_text()
        for hostile, message in (("a\0b", "zero byte"), ("y" * 100_000, "1000 characters")):
            lines(block / table, lambda L, h=hostile: [*L, ",".join([h, *L[-1].split(",")[1:]])])
            assert message in refused(photoplan, block, "adjust")
            (block / table).write_text(text)

    def test_fault_11_of_images_and_outputs(self, photoplan: Here, block: Path) -> None:
        """Tables name images that are not there; the project's own lead nowhere either."""
        lines(block / "points.csv", lambda L: [*L, 'T1,"../../../etc/passwd",1,2', "T2,/etc/shadow,3,4"])
        said = photoplan("adjust", block / "project.toml", "--dry-run")
        assert said.code == 0, said.err
        assert "2 images of the measurements are not in the project" in said.err
        edit(block / "project.toml", 'image_points = ["points.csv"]', 'image_points = ["/vsicurl/http://x/points.csv"]')
        assert "virtual file systems are not read" in refused(photoplan, block, "adjust")


class TestOutputs:
    @pytest.mark.slow
    def test_fault_13_reports_that_exist_are_kept(self, photoplan: Here, block: Path) -> None:
        project = block / "project.toml"
        assert photoplan("adjust", project, "-q").code == 0
        assert "exists already" in refused(photoplan, block, "adjust", code=2)
        assert photoplan("adjust", project, "-q", "--overwrite").code == 0

    def test_fault_13_an_output_is_no_input(self, photoplan: Here, block: Path) -> None:
        (block / "points.csv").rename(block / "image_points.csv")
        edit(block / "project.toml", '["points.csv"]', '["image_points.csv"]')
        for verb, words in (
            ("adjust", ("-o", block, "--overwrite")),
            ("resect", ("--report", block / "image_points.csv", "--overwrite")),
            ("resect", ("--report", block / "project.toml", "--overwrite")),
            ("resect", ("--report", block / "positions.csv", "--overwrite")),
        ):
            assert "the output is the input" in refused(photoplan, block, verb, *words, code=2)

    @SKIP_ROOT
    def test_fault_29_a_read_only_folder(self, photoplan: Here, block: Path) -> None:
        block.chmod(0o555)
        try:
            assert str(block) in refused(photoplan, block, "adjust", code=2)
        finally:
            block.chmod(0o755)

    def test_fault_29_a_folder_that_cannot_be_made(self, photoplan: Here, block: Path) -> None:
        for where in ("/proc/nowhere", block / "points.csv" / "deeper"):
            said = photoplan("adjust", block / "project.toml", "-o", where)
            assert said.code in (2, 5), said
            assert str(where) in said.err
        assert "sigma_center" not in (block / "project.toml").read_text()


class TestReadings:
    def test_fault_14_wrong_unit_and_order(self, photoplan: Here, original: Path, tmp_path: Path) -> None:
        """Degrees declared as gon are suspicious to nobody; measured points tell."""
        block = Path(shutil.copytree(original.parent, tmp_path / "block"))
        assert photoplan("adjust", block / "project.toml", "-q").code == 0
        table = block / "table.csv"
        assert photoplan("convert", block / "project.toml", "--to", "csv", "-o", table).code == 0
        points = ("--image-points", block / "points.csv", "--control", block / "control.csv")
        # Turned by 0.9, as if a table in gon had been taken for one in degrees.
        rows = [line.split(",") for line in table.read_text().strip().split("\n")]
        gon = [rows[0], *([*r[:4], *(repr(float(v) / 0.9) for v in r[4:7]), *r[7:]] for r in rows[1:])]
        table.write_text("\n".join(map(",".join, gon)) + "\n")
        camera = ("--camera", block / "project.toml")
        said = photoplan("convert", table, "--list-readings", *camera, *points)
        assert said.code == 0, said.err
        best = said.out.split("\n")[0]
        assert "fits" in best and "--angle-unit gon" in best
        assert "--rotation-direction ground-to-camera" not in best

    def test_fault_14_check_names_the_other_unit(self, photoplan: Here, block: Path) -> None:
        """Degrees declared as radians are more than full circles."""
        height = '[terrain]\nheight = 500.0\nheight_system = "same"\n[orientation]\n'
        edit(block / "project.toml", "[orientation]\n", height)
        edit(block / "project.toml", 'angle_unit = "deg"', 'angle_unit = "rad"')
        for k in range(8):
            name = "ab"[k // 4] + str(k % 4 + 1)
            with rasterio.open(
                block / f"{name}.tif",
                "w",
                driver="GTiff",
                width=4000,
                height=3000,
                count=1,
                dtype="uint8",
                transform=Affine.identity(),
                sparse_ok=True,
                tiled=True,
            ):
                pass
        said = photoplan("check", block / "project.toml")
        assert said.code == 3, said
        assert "angle -177.356 is more than a full circle in rad; is it in deg or gon?" in said.err


class TestGeometry:
    def alone(self, block: Path) -> None:
        """Control only: nothing else says where the block lies."""
        edit(block / "project.toml", POSITIONS, "")

    @pytest.mark.slow
    def test_fault_16_control_on_a_line_in_adjust(self, photoplan: Here, block: Path) -> None:
        """Two control points leave the turn about the line through them."""
        self.alone(block)
        lines(block / "control.csv", lambda L: L[:3])
        said = refused(photoplan, block, "adjust")
        assert "1 direction of the unknowns free" in said
        assert "rotation of the block about the line through X" in said

    def test_fault_16_no_datum(self, photoplan: Here, block: Path) -> None:
        self.alone(block)
        edit(block / "project.toml", CONTROL, "")
        said = refused(photoplan, block, "adjust")
        for words in ("position of the block in X", "rotation of the block about Z", "scale of the block"):
            assert words in said

    def test_fault_16_control_on_a_line_in_resect(self, photoplan: Here, block: Path) -> None:
        lines(
            block / "control.csv", lambda L: [L[0], *(f"L{k},{689700 + 150 * k},5349990,500,control" for k in range(5))]
        )
        lines(block / "points.csv", lambda L: [L[0], *(f"L{k},a2.tif,{1500 + 300 * k},1500" for k in range(5))])
        said = refused(photoplan, block, "resect")
        assert "image 'a2': all 5 points lie on one line" in said

    @pytest.mark.parametrize("verb", ["resect", "adjust"])
    def test_fault_16_flat_ground_and_free_camera_constant(self, photoplan: Here, tmp_path: Path, verb: str) -> None:
        """Camera constant and flying height cannot be told apart where images are vertical and the ground is flat."""
        flat_block(tmp_path)
        words = ("--free", "c", "--images", "i0") if verb == "resect" else ("--calibrate", "c")
        said = refused(photoplan, tmp_path, verb, *words)
        assert "c" in said.replace(",", " ").replace(":", " ").split() or "camera constant" in said
        assert "Z0" in said

    @pytest.mark.slow
    def test_fault_16_no_overlap_in_tie(self, photoplan: Here, tmp_path: Path) -> None:
        pytest.importorskip("cv2")
        random = np.random.default_rng(4)
        images = []
        for k in range(3):
            coarse = random.integers(0, 255, (40, 60)).astype(np.uint8)
            with rasterio.open(
                tmp_path / f"i{k}.tif",
                "w",
                driver="GTiff",
                width=600,
                height=400,
                count=1,
                dtype="uint8",
                transform=Affine.identity(),
            ) as file:
                file.write(np.kron(coarse, np.ones((10, 10), np.uint8)), 1)
            images.append(f'[[images]]\nname = "i{k}"\nfile = "i{k}.tif"\ncamera = "c"\n')
        head = 'crs = "EPSG:25832"\n[orientation]\nheight_system = "same"\n'
        head += "[cameras.c]\nsize = [600, 400]\nfocal_px = 600.0\n"
        (tmp_path / "project.toml").write_text(head + "".join(images))
        said = photoplan("tie", tmp_path / "project.toml", "--workers", 1)
        assert said.code == 3, said
        assert "overlap" in said.err
        assert not (tmp_path / "tie_points.csv").exists()

    def test_fault_16_nothing_that_is_written_holds_nan(self, photoplan: Here, block: Path) -> None:
        """Points without redundancy, points in one image, check points without height, gross errors at two rays."""
        lines(block / "control.csv", lambda L: [*L[:-1], ",".join([*L[-1].split(",")[:3], "", "check"])])
        lines(block / "points.csv", lambda L: [*L, "Z1,a1.tif,100,100", "Z2,a1.tif,200,200", "Z2,a2.tif,3900,2900"])
        said = photoplan("adjust", block / "project.toml", "--calibrate", "c,k1")
        no_nan(said, block)
        assert "'Z2'" in said.err
        said = photoplan("resect", block / "project.toml", "--overwrite")
        no_nan(said, block)


def flat_block(folder: Path) -> None:
    """Two vertical images over level ground with eight points each, exact."""
    c, Z0, size = 3600.0, 1200.0, (4000, 3000)
    image, control = ["point,image,x,y"], ["name,x,y,z"]
    for k in range(12):
        X, Y = 500_000.0 + 200.0 * (k % 4) - 300.0, 5_400_000.0 + 250.0 * (k // 4 - 1)
        control.append(f"P{k},{X},{Y},0")
        for n, X0 in enumerate((499_900.0, 500_100.0)):
            x = (size[0] - 1) / 2 + c * (X - X0) / Z0
            y = (size[1] - 1) / 2 - c * (Y - 5_400_000.0) / Z0
            if 0 < x < size[0] - 1 and 0 < y < size[1] - 1:
                image.append(f"P{k},i{n},{x:.6f},{y:.6f}")
    (folder / "points.csv").write_text("\n".join(image) + "\n")
    (folder / "control.csv").write_text("\n".join(control) + "\n")
    images = "".join(
        f'[[images]]\nname = "i{n}"\nfile = "i{n}.tif"\ncamera = "flat"\ncenter = [{X0}, 5400000.0, {Z0}]\n'
        "angles = [0.0, 0.0, 0.0]\n"
        for n, X0 in enumerate((499_900.0, 500_100.0))
    )
    (folder / "project.toml").write_text(
        'crs = "EPSG:25832"\n[orientation]\nheight_system = "same"\n[observations]\nimage_points = ["points.csv"]\n'
        'control = ["control.csv"]\nsigma_control = [0.02, 0.02]\nsigma_image = 0.3\n'
        f"[cameras.flat]\nsize = {list(size)}\nfocal_px = {c}\n{images}"
    )


class TestGrossErrors:
    @pytest.mark.slow
    def test_fault_17_in_adjust_are_named(self, photoplan: Here, block: Path) -> None:
        """One measurement by 40 pixels, one control height by 20 m."""

        def wrong(L: list[str]) -> list[str]:
            point, image, x, y = L[7].split(",")
            wrong.name = (point, image)  # type: ignore[attr-defined]
            return [*L[:7], f"{point},{image},{float(x) + 40:.3f},{y}", *L[8:]]

        lines(block / "points.csv", wrong)
        lines(block / "control.csv", lambda L: [*L[:5], L[5].replace(",476.", ",496."), *L[6:]])
        assert ",496." in (block / "control.csv").read_text()
        said = photoplan("adjust", block / "project.toml")
        no_nan(said, block)
        point, image = wrong.name  # type: ignore[attr-defined]
        gross = [line for line in said.err.split("\n") if line.startswith("note: gross error")]
        assert any(f"'{point}'" in g and f"'{image[:2]}'" in g for g in gross), gross
        assert any("control point 'G5', Z" in g for g in gross), gross
        assert len(gross) <= 4
        found = json.loads((block / "adjustment" / "report.json").read_text())
        assert len(found["gross_errors"]) == len(gross)

    def test_fault_17_in_resect_are_named(self, photoplan: Here, block: Path) -> None:
        """All ground points of the middle images, one of them 30 pixels off."""
        lines(block / "control.csv", lambda L: [line.replace("check", "control") for line in L])
        found = rendered(block)
        lines(block / "points.csv", lambda L: [L[0], *found])
        lines(block / "points.csv", lambda L: [*L[:3], bent(L[3], 30.0), *L[4:]])
        name = (block / "points.csv").read_text().split("\n")[3].split(",")[0]
        said = photoplan("resect", block / "project.toml", "--images", "a2", "--json", "--dry-run")
        assert said.code == 0, said.err
        (image,) = json.loads(said.out)["images"]
        assert [p["name"] for p in image["points"] if p["rejected"]] == [name]
        said = photoplan("resect", block / "project.toml", "--images", "a2")
        assert f"'{name}'" in said.out + said.err and "gross" in said.out + said.err
        no_nan(said, block)


def rendered(block: Path) -> list[str]:
    """Twelve control points, written, and their lines of measurements in image a2."""
    from photoplan.cameras.base import project as project_points
    from photoplan.cameras.framed import oriented_camera
    from photoplan.geometry.pose import Pose
    from photoplan.io.project.file import load_project
    from photoplan.io.project.model import interior_of, lens_of

    project = load_project(block / "project.toml")
    image = project.image("a2")
    center, angles = image.pose_numbers
    camera = oriented_camera(
        interior_of(project.cameras["cam"], image),
        lens_of(project.cameras["cam"]),
        Pose.from_angles(center, np.radians(angles), "opk"),
        crs=project.crs,
        earth_curvature="strict",
        refraction=False,
        mean_ground=500.0,
    )
    random, control, out = np.random.default_rng(3), [], []
    for k in range(12):
        XYZ = np.array([center[0] + 250.0 * (k % 4 - 1.5), center[1] + 300.0 * (k // 4 - 1), 500.0 + 15.0 * (k % 3)])
        x, y = project_points(camera, XYZ) + random.normal(0, 0.3, 2)
        out.append(f"N{k},a2.tif,{x:.3f},{y:.3f}")
        control.append(f"N{k},{XYZ[0]:.4f},{XYZ[1]:.4f},{XYZ[2]:.4f},control")
    lines(block / "control.csv", lambda L: [L[0], *control])
    return out


def bent(line: str, by: float) -> str:
    point, image, x, y = line.split(",")
    return f"{point},{image},{float(x) + by:.3f},{y}"


SPOILT = {
    "NaN": (lambda L: [*L[:3], L[3].rsplit(",", 1)[0] + ",nan", *L[4:]], ":4"),
    "infinite": (lambda L: [*L[:3], L[3].rsplit(",", 1)[0] + ",1e999", *L[4:]], ":4"),
    "no number": (lambda L: [*L[:3], L[3].rsplit(",", 1)[0] + ",abc", *L[4:]], ":4"),
    "ragged": (lambda L: [*L[:3], L[3].rsplit(",", 1)[0], *L[4:]], ":4"),
    "longer": (lambda L: [*L[:3], L[3] + ",1,2,3", *L[4:]], ":4"),
    "header only": (lambda L: L[:1], "header and no line"),
    "empty": (lambda L: [""], "no line with data"),
    "twice": (lambda L: [*L, *L[1:]], None),
}


class TestTables:
    """Fault 18: a damaged table is refused with file and line, an odd one is read as it is meant."""

    @pytest.mark.parametrize("spoilt", SPOILT)
    @pytest.mark.parametrize("table", ["points.csv", "control.csv", "positions.csv"])
    def test_fault_18_is_refused_by_its_line(self, photoplan: Here, block: Path, table: str, spoilt: str) -> None:
        change, message = SPOILT[spoilt]
        if table != "points.csv" and spoilt in ("NaN", "infinite", "no number"):
            # The last column is a role or a strip: spoil the height.
            bad = {"NaN": "nan", "infinite": "1e999", "no number": "abc"}[spoilt]

            def change(L: list[str]) -> list[str]:
                fields = L[3].split(",")
                return [*L[:3], ",".join([*fields[:3], bad, *fields[4:]]), *L[4:]]

        lines(block / table, change)
        said = refused(photoplan, block, "adjust")
        assert table + (message or "") in said.replace(": ", "") or (message or table) in said, said
        assert table in said

    @pytest.mark.parametrize("table", some(["points.csv", "control.csv", "positions.csv"], 0))
    def test_fault_18_bom_crlf_and_semicolons_are_read(self, photoplan: Here, block: Path, table: str) -> None:
        expected = json.loads(photoplan("adjust", block / "project.toml", "--dry-run", "--json", "-q").out)
        text = (block / table).read_text().replace(",", ";").replace("\n", "\r\n")
        (block / table).write_bytes(b"\xef\xbb\xbf" + text.encode())
        said = photoplan("adjust", block / "project.toml", "--dry-run", "--json", "-q")
        assert said.code == 0, said.err
        assert json.loads(said.out)["sigma0"] == pytest.approx(expected["sigma0"], rel=1e-9)

    @pytest.mark.parametrize("table", ["points.csv", "control.csv", "positions.csv"])
    def test_fault_18_decimal_commas_are_refused_by_name(self, photoplan: Here, block: Path, table: str) -> None:
        text = (block / table).read_text().replace(",", ";").replace(".tif", "").replace(".", ",")
        (block / table).write_text(text)
        said = refused(photoplan, block, "adjust")
        assert f"{table}:2: " in said and "write decimals with a point" in said

    @pytest.mark.parametrize(
        ("spoilt", "message"),
        [
            ("nan 5350000 500 10 10 a1.tif H1", ":2"),
            ("690000 5350000 500 10", ":2"),
            ("690000,5 5350000,5 500,0 10 10 a1.tif H1", ":2"),
            ("", "no"),
        ],
    )
    def test_fault_18_gcp_list(self, photoplan: Here, block: Path, spoilt: str, message: str) -> None:
        (block / "gcp_list.txt").write_text(f"EPSG:25832\n{spoilt}\n")
        edit(block / "project.toml", '["control.csv"]', '["gcp_list.txt"]')
        said = refused(photoplan, block, "adjust")
        assert "gcp_list.txt" in said and message in said

    def test_points_outside_their_image(self, photoplan: Here, block: Path) -> None:
        edit(block / "project.toml", "size = [4000, 3000]", "size = [2000, 1500]")
        said = refused(photoplan, block, "adjust")
        assert "lies outside the image of 2000 × 1500 pixels" in said and "of another size" in said

    def test_control_of_another_place(self, photoplan: Here, block: Path) -> None:
        """Exchanged X and Y."""
        lines(block / "control.csv", lambda L: [L[0].replace("x,y", "y,x"), *L[1:]])
        said = refused(photoplan, block, "adjust")
        assert "control point 'G" in said and "lies" in said and "are X and Y exchanged" in said


class TestInterruption:
    def test_fault_25_ctrl_c_leaves_the_project_as_it_was(self, block: Path) -> None:
        """While the adjustment reads half a million measurements."""
        rows = [f"Q{k // 2},{'ab'[k % 2]}1.tif,{k % 3990},{k % 2990}" for k in range(400_000)]
        lines(block / "points.csv", lambda L: [*L, *rows])
        before = state(block)
        running = start("adjust", block / "project.toml")
        mapped = Path(f"/proc/{running.pid}/maps")
        wait_for(lambda: not mapped.exists() or "scipy" in mapped.read_text(), running)
        os.killpg(running.pid, signal.SIGINT)
        out, err = running.communicate(timeout=120)
        assert running.returncode == 130, (out, err)
        assert "Traceback" not in err
        assert state(block) == before

    @pytest.mark.slow
    def test_fault_25_ctrl_c_in_tie(self, tmp_path: Path) -> None:
        """While features are sought: no table, no entry in the project, no child left behind."""
        pytest.importorskip("cv2")
        data = Path(photoplan_package.__file__).parent / "demo_block"
        words = (
            "--images",
            data / "images" / "*.jpg",
            "--camera",
            data / "int.yaml",
            "--orientation",
            data / "ext.csv",
        )
        said = inside("init", tmp_path, *words, "--height-system", "same")
        assert said.code == 0, said.err
        before = (tmp_path / "project.toml").read_bytes()
        running = start("tie", tmp_path / "project.toml", "--workers", 1)
        kept = tmp_path / "tie_points.matches"
        wait_for(lambda: kept.is_file() and kept.stat().st_size > 0, running)
        os.killpg(running.pid, signal.SIGINT)
        out, err = running.communicate(timeout=120)
        assert running.returncode == 130, (out, err)
        assert "Traceback" not in err
        assert (tmp_path / "project.toml").read_bytes() == before
        assert not (tmp_path / "tie_points.csv").exists()

    def test_what_is_edited_meanwhile_stays(
        self, photoplan: Here, block: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Results are entered into the file as it is when they are there, not as it was."""
        path, facts = block / "project.toml", adjust.summarise

        def meanwhile(*given: object) -> object:
            edit(path, "# a remark that stays", "# a remark that was changed\n# and another one")
            return facts(*given)

        monkeypatch.setattr(adjust, "summarise", meanwhile)
        assert photoplan("adjust", path).code == 0
        text = path.read_text()
        assert "# a remark that was changed\n# and another one" in text and "sigma_center" in text

    def test_a_project_that_vanishes_meanwhile(
        self, photoplan: Here, block: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path, facts = block / "project.toml", adjust.summarise

        def meanwhile(*given: object) -> object:
            path.rename(block / "elsewhere.toml")
            return facts(*given)

        monkeypatch.setattr(adjust, "summarise", meanwhile)
        said = photoplan("adjust", path)
        assert said.code in (2, 3), said
        assert "project.toml" in said.err
        assert not path.exists()
