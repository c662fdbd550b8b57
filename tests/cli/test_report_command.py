"""`photoplan report`: what the runs of a project have found, on one page; old, broken and hostile records."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tools.command import Here
from tools.small_block import Block

from photoplan.io.files import fingerprint

SAID = {"key": "0" * 64, "versions": {"photoplan": "0.1"}}


def record(path: Path, kind: str, product: dict[str, Any], inputs: tuple[Path, ...] = (), **more: Any) -> Path:
    """Write a run record as a command leaves it."""
    path.parent.mkdir(exist_ok=True)
    entries = [
        {
            "path": os.path.relpath(file, path.parent),
            "size": file.stat().st_size,
            "sampled_sha256": fingerprint(file).digest,
        }
        for file in inputs
    ]
    values = {"file": path.name.replace(".run.json", ".csv"), "kind": kind, "product": product, "inputs": entries}
    values |= {"run": {"finished": "2026-05-01T10:00:00+00:00"}, **SAID, **more}
    path.with_name(str(values["file"])).write_text("x\n")
    path.write_text(json.dumps(values))
    return path


@pytest.fixture
def project(small: Block) -> Path:
    """A block with tie points that were recorded."""
    folder = small.folder
    ties = {"points": 1234, "sigma": 0.043, "pairs": {"tried": 3, "verified": 2}, "notes": ["one pair is weak"]}
    record(folder / "ties.run.json", "tie points", ties, (folder / "images" / "one.tif",))
    return folder


def adjusted(folder: Path, **more: Any) -> Path:
    """Leave what an adjustment leaves."""
    product = {"sigma0": 1.02, "redundancy": 800, "rejected": 2}
    made = record(folder / "adjustment" / "report.run.json", "adjust", product, file="report.json")
    groups = [{"name": "image points", "count": 900, "redundancy": 790.0, "rms": 0.31, "unit": "px"}]
    values = {"sigma0": 1.02, "redundancy": 800, "gross_errors": [{}, {}], "groups": groups,
              "notes": ["errors are alike"], "check_accuracy": {"RMSE_H": 0.021, "RMSE_V": 0.034}, **more}  # fmt: skip
    (folder / "adjustment" / "report.json").write_text(json.dumps(values))
    return made


def figures(said: Any, section: str) -> dict[str, Any]:
    return {each["name"]: each for each in json.loads(said.out)["sections"][section]["figures"]}


def test_all_that_was_found_stands_in_the_order_of_the_chain(photoplan: Here, project: Path) -> None:
    adjusted(project)
    assert photoplan("ortho", project, "--resolution", "4", "-q").code == 0
    said = photoplan("report", project)
    assert said.code == 0, said.err
    assert said.out.splitlines()[0].endswith("report.html")
    titles = [line for line in said.out.splitlines()[1:] if not line.startswith(" ")]
    assert titles == ["Missing", "Images and cameras", "Tie points and control", "Adjustment", "Products", "Accuracy"]
    assert re.search(r"sigma0 +1\.020? ± 0\.02[56]", said.out)
    assert re.search(r"standard deviation of an image point +0\.043 px", said.out)
    assert re.search(r"check points, height +0\.034 m", said.out)
    assert "balance" in said.out
    assert "no adjustment" not in said.out
    html = (project / "report.html").read_text()
    assert [*re.findall("<h2>(.*?)</h2>", html)] == ["Warnings, gaps and notes", *titles[1:], "Source files"]
    assert "ties.csv: one pair is weak" in html
    assert "adjustment/report.json: errors are alike" in html
    assert "one_ortho.run.json" in html
    assert "photoplan balance" in html
    assert str(project) not in html
    refused = photoplan("report", project)
    assert refused.code == 2
    assert "exists" in refused.err
    again = photoplan("report", project, "--overwrite", "--json")
    assert figures(again, "Tie points and control")["points"]["value"] == 1234
    assert figures(again, "Adjustment")["sigma0"]["sigma"] == pytest.approx(1.02 / 40)
    assert figures(again, "Adjustment")["gross_errors"]["value"] == 2
    assert figures(again, "Products")["products"]["value"] == 3
    assert all(not each["old"] for each in json.loads(again.out)["records"])


@pytest.mark.drawn
def test_the_ending_makes_it_a_pdf(photoplan: Here, project: Path, tmp_path: Path) -> None:
    said = photoplan("report", project, "-o", tmp_path / "quality.pdf")
    assert said.code == 0, said.err
    assert (tmp_path / "quality.pdf").read_bytes().startswith(b"%PDF")
    assert not (project / "report.html").exists()


def test_what_is_missing_is_named(photoplan: Here, project: Path) -> None:
    said = photoplan("report", project, "--no-check", "--json", "-q")
    missing = json.loads(said.out)["missing"]
    assert "photoplan adjust" in missing["adjustment"]
    assert "photoplan ortho" in missing["products"]
    assert "tie points" not in missing
    assert "check points" in missing


def test_results_of_other_inputs_are_old(photoplan: Here, project: Path) -> None:
    assert photoplan("ortho", project, "--resolution", "4", "-q").code == 0
    file = project / "project.toml"
    text = file.read_text()
    moved = re.sub(r"center = \[\d", lambda found: found[0][:-1] + "4", text, count=1)
    assert moved != text
    file.write_text(moved)
    with (project / "images" / "two.tif").open("ab") as image:
        image.write(b"\0")
    said = photoplan("report", project, "--no-check", "--json", "-q")
    old = {each["name"]: each["old"] for each in json.loads(said.out)["records"] if each["old"]}
    assert old == {
        "products/one_ortho.tif": ["the orientation of 1 image has changed"],
        "products/two_ortho.tif": ["two.tif has changed"],
    }
    assert "warning: old, two.tif has changed: products/two_ortho.tif" in said.err
    (project / "products" / "three_ortho.tif").unlink()
    (project / "images" / "one.tif").unlink()
    said = photoplan("report", project, "--no-check", "--json", "--overwrite", "-q")
    old = {each["name"]: each["old"] for each in json.loads(said.out)["records"] if each["old"]}
    assert old["products/three_ortho.tif"] == ["its product is missing"]
    assert old["ties.csv"] == ["one.tif is missing"]


def test_a_later_adjustment_makes_seams_old(photoplan: Here, project: Path) -> None:
    record(project / "products" / "seams.run.json", "seams", {"found": 3.0, "halfway": 5.0})
    adjusted(project)
    text = (project / "adjustment" / "report.run.json").read_text()
    (project / "adjustment" / "report.run.json").write_text(text.replace("2026-05-01", "2026-05-02"))
    said = photoplan("report", project, "--no-check")
    assert "old, images were oriented again on 2026-05-02 10:00 UTC: products/seams.csv" in said.err


def _broken(folder: Path) -> None:
    (folder / "a.run.json").write_text("{not json")


def _other(folder: Path) -> None:
    (folder / "a.run.json").write_text('{"file": 3, "key": 1, "versions": {}}')


def _listed(folder: Path) -> None:
    (folder / "a.run.json").write_text("[1, 2]")


def _deep(folder: Path) -> None:
    (folder / "a.run.json").write_text("[" * 200_000)


def _link(folder: Path) -> None:
    (folder / "a.run.json").symlink_to(folder / "ties.run.json")


def _pipe(folder: Path) -> None:
    os.mkfifo(folder / "a.run.json")


def _binary(folder: Path) -> None:
    (folder / "a.run.json").write_bytes(b"\xff\xfe\x00" * 100)


@pytest.mark.parametrize("spoil", [_broken, _other, _listed, _deep, _link, _pipe, _binary])
def test_a_record_that_is_none_is_left_out_and_named(
    photoplan: Here, project: Path, spoil: Callable[[Path], None]
) -> None:
    spoil(project)
    said = photoplan("report", project, "--no-check", "--json")
    assert said.code == 0, said.err
    assert "warning: a.run.json: is left out: " in said.err
    assert [each["name"] for each in json.loads(said.out)["records"]] == ["ties.csv"]


def test_a_hostile_record_shows_no_other_file_and_runs_nothing(photoplan: Here, project: Path) -> None:
    secret = project.parent / "secret.txt"
    secret.write_text("do not look")
    (project / "inside.txt").symlink_to(secret)
    evil = "<script>alert(1)</script>\u202e\x1b[31m"
    hostile = record(project / "bad.run.json", evil, {
        evil: 1, "huge": 10**400, "yes": True, "notes": [evil, 3, None, "n" * 10**6], "points": {"a": []},
        "figures": "none", "advice": evil, "value_m": 2.5,
    })  # fmt: skip
    values = json.loads(hostile.read_text())
    paths = ("../secret.txt", str(secret), "/dev/zero", "inside.txt", "\0", "x" * 3000)
    values["inputs"] = [{"path": each, "size": 11, "sampled_sha256": "0" * 64} for each in paths]
    values |= {"file": "../secret.txt", "project": {"images": [{"name": "one"}, 5, {"name": []}]}}
    values["run"] = {"finished": "0001-01-01T00:00:00+14:00"}
    hostile.write_text(json.dumps(values))
    adjusted(project, sigma0="high", redundancy=-1, groups=[3, {"name": evil, "count": "x"}], check_accuracy=[1])
    said = photoplan("report", project)
    assert said.code == 0, said.err
    html = (project / "report.html").read_text()
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    assert "\u202e" not in html
    assert "\x1b" not in said.out + said.err
    assert "secret" not in html + said.out + said.err
    assert "zero" not in html
    assert len(html) < 300_000


def test_a_folder_without_records_gets_a_report(photoplan: Here, small: Block, tmp_path: Path) -> None:
    said = photoplan("report", small.folder)
    assert said.code == 0, said.err
    assert "run `photoplan tie`" in said.out
    assert "Images and cameras" in said.out
    assert photoplan("report", tmp_path / "none").code == 3


def test_every_product_of_a_large_project_is_listed(photoplan: Here, project: Path) -> None:
    for k in range(40):
        record(project / "products" / f"p{k}_ortho.run.json", "orthophoto", {"image": "one", "valid_share": 0.5})
    assert photoplan("report", project, "--no-check").code == 0
    html = (project / "report.html").read_text()
    products = html[html.index("<h2>Products</h2>") : html.index("<h2>Source files</h2>")]
    assert [k for k in range(40) if f"products/p{k}_ortho.csv" not in products] == []
    assert "The first" not in html


def test_a_project_whose_images_wait_for_an_orientation_has_a_report(photoplan: Here, tmp_path: Path) -> None:
    images = "".join(f'[[images]]\nname = "{n}"\nfile = "{n}.tif"\ncamera = "c"\n' for n in "ab")
    camera = '[cameras.c]\ntype = "frame"\nsize = [100, 100]\nfocal_px = 100.0\n'
    (tmp_path / "project.toml").write_text(f'format = 1\ncrs = "EPSG:32633"\n{camera}{images}')
    record(tmp_path / "ties.run.json", "tie points", {"points": 77})
    said = photoplan("report", tmp_path, "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["missing"]["orientation"] == "2 images of 2 have none"
    assert figures(said, "Tie points and control")["points"]["value"] == 77


def test_messages_on_broken_records_do_not_name_the_folder_of_the_project(photoplan: Here, project: Path) -> None:
    adjusted(project)
    (project / "adjustment" / "report.json").write_text("{")
    (project / "cut.run.json").write_text('{"file": ')
    odd = {"file": 5, "kind": 5, **SAID}
    (project / "odd.run.json").write_text(json.dumps(odd))
    said = photoplan("report", project)
    assert said.code == 0 and str(project) not in said.err
    assert "odd.run.json: is left out: file: 5 given; allowed is a valid string kind: 5 given" in said.err
    assert "cut.run.json: is left out: cut.run.json:1: not valid JSON" in said.err
