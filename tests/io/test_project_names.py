"""Names from tables never lead out of a folder or to a device (faults 9, 11, 12)."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from photoplan.errors import InputError
from photoplan.io.files import (
    ImageNames,
    check_input_name,
    match_key,
    resolve_input,
    safe_stem,
    same_images,
    shortest_paths,
    unique_stems,
)


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("DJI_0018.jpg", "DJI_0018"),
        ("3324c_2015_1004_05_0182_RGB", "3324c_2015_1004_05_0182_RGB"),
        ("IMG.0001", "IMG.0001"),
        ("flight 1/IMG.0001.TIF", "IMG.0001"),
        ("../../etc/passwd", "passwd"),
        (r"..\..\Windows\win.ini", "win.ini"),
        ("/absolute/name.tif", "name"),
        ("C:\\x\\name.tif", "name"),
        ("CON", "CON_"),
        ("nul.txt", "nul_.txt"),
        ("Lpt1.tif", "Lpt1_"),
        ("console", "console"),
        ("Übersicht 1.tif", "Übersicht_1"),
        ("日本.jp2", "日本"),
        ("-rf", "rf"),
        (".hidden", "hidden"),
        ("trailing. ", "trailing"),
        ('a:b*c?d|e<f>g"h', "a_b_c_d_e_f_g_h"),
        ("new\nline\0zero", "new_line_zero"),
    ],
)
def test_fault_11_stems(name: str, stem: str) -> None:
    assert safe_stem(name) == stem


@pytest.mark.parametrize("name", ["", "..", "/", "...", "../..", ".tif", "__", "\0"])
def test_fault_11_a_name_of_nothing_is_refused(name: str) -> None:
    with pytest.raises(InputError, match="no letter or digit"):
        safe_stem(name)


def test_fault_11_long_names_are_cut_and_stay_different() -> None:
    a, b = safe_stem("ä" * 3000 + "1"), safe_stem("ä" * 3000 + "2")
    assert a != b
    assert max(len(a.encode()), len(b.encode())) <= 120


@given(st.text(max_size=60))
def test_fault_11_any_name_gives_a_plain_stem_or_an_error(name: str) -> None:
    try:
        stem = safe_stem(name)
    except InputError:
        return
    assert stem == Path(stem).name
    assert not any(c in stem for c in '/\\:*?"<>|\0\n ')
    assert not stem.startswith((".", "-"))
    assert not stem.endswith(".")
    assert 0 < len(stem.encode()) <= 120
    assert safe_stem(stem + ".tif") == stem
    assert (Path("/out") / f"{stem}_ortho.tif").resolve().parent == Path("/out")


def test_fault_12_equal_base_names_get_distinct_stems() -> None:
    names = ["a/IMG_1.tif", "IMG_2.tif", "b/img_1.jpg", "x/b/img_1.jpg", "X 3", "X_3", "x_3"]
    stems = unique_stems(names)
    assert list(stems.values()) == ["a_IMG_1", "IMG_2", "b_img_1", "x_b_img_1", "X_3", "X_3_2", "x_3_3"]
    assert unique_stems(["x/1.tif", "2"]) == {"x/1.tif": "1", "2": "2"}


@given(
    st.lists(st.sampled_from(["a", "b/a", "c/a", "x/c/a", "a.tif", "A", "a_", "b_a", "c/a.jpg", "C:/c/a"]), unique=True)
)
def test_fault_12_stems_are_always_distinct(names: list[str]) -> None:
    stems = [stem.casefold() for stem in unique_stems(names).values()]
    assert len(set(stems)) == len(names)


def test_images_are_found_by_any_spelling() -> None:
    names = ImageNames(["100/DJI_1.JPG", "101/DJI_1.JPG", "b", "Ü.tif"])
    assert names.find("b.TIF") == "b"
    assert names.find("/any/where/B.jpg") == "b"
    assert names.find("U\u0308") == "Ü.tif"
    assert names.find("c") is None
    assert names.find(r"D:\flight\101\dji_1.jpg") == "101/DJI_1.JPG"
    for doubtful in ("DJI_1", "102/DJI_1.JPG"):
        with pytest.raises(InputError, match=r"may be '100/DJI_1.JPG' or '101/DJI_1.JPG'"):
            names.find(doubtful)
    assert names.match(["x/b", "101/DJI_1"]) == ["b", "101/DJI_1.JPG"]
    # The better of two spellings is the image; the other one is another image.
    assert ImageNames(["p/b"]).match(["q/b", "p/b"]) == [None, "p/b"]
    with pytest.raises(InputError, match=r"'q/b' and 'r/b' are both image 'b'"):
        ImageNames(["b"]).match(["q/b", "r/b"])


def test_spellings_within_one_file() -> None:
    assert same_images(["a/1.tif", "1", "b/2", "c/2"]) == {
        "a/1.tif": "a/1.tif",
        "1": "a/1.tif",
        "b/2": "b/2",
        "c/2": "c/2",
    }
    with pytest.raises(InputError, match="'2' may be 'b/2' or 'c/2'"):
        same_images(["b/2", "c/2", "2"])


@pytest.mark.parametrize(
    "text",
    [
        "/vsicurl/https://example.org/a.tif",
        "/VSIZIP/a.zip/a.tif",
        "//vsis3/bucket/a.tif",
        "\\vsimem\\a.tif",
        "  /vsistdin/",
        "https://example.org/a.tif",
        "ftp://example.org/a",
        "file:///etc/passwd",
        "zip+file://a.zip!a.tif",
        "NETCDF:a.nc:v",
        "GTIFF_DIR:1:a.tif",
        "WMS:http://x",
        "<VRTDataset>",
        '{"type": "gdal"}',
        "a\0b.tif",
        "a\nb.tif",
        "",
        "   ",
    ],
)
def test_fault_09_only_plain_paths_are_inputs(text: str) -> None:
    with pytest.raises(InputError):
        check_input_name(text)


@pytest.mark.parametrize(
    "text", ["a.tif", "../data/a b.tif", "C:\\data\\a.tif", "c:/data/a.tif", "/data/vsi.tif", "ä.tif"]
)
def test_plain_paths_are_inputs(text: str) -> None:
    assert check_input_name(text) == text


def test_fault_09_a_relative_path_cannot_become_virtual(tmp_path: Path) -> None:
    climb = "../" * len(tmp_path.parts)
    with pytest.raises(InputError, match="virtual"):
        resolve_input(tmp_path, f"{climb}vsicurl/x.tif")
    assert resolve_input(tmp_path, "a/../b.tif") == (tmp_path / "b.tif").resolve()


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        ("DJI_0018.jpg", "images/DJI_0018.TIF", True),
        ("DJI_0018", "DJI_0018.jpeg", True),
        (unicodedata.normalize("NFD", "Übung.tif"), "Übung", True),
        ("IMG.1", "IMG.2", False),
        ("IMG_1", "img_1", False),
    ],
)
def test_names_are_compared_without_folder_and_suffix(a: str, b: str, same: bool) -> None:
    assert (match_key(a) == match_key(b)) is same


def test_a_link_to_itself_is_an_input_that_leads_nowhere(tmp_path: Path) -> None:
    (tmp_path / "loop.obj").symlink_to(tmp_path / "loop.obj")
    with pytest.raises(InputError, match="leads to no file"):
        resolve_input(tmp_path, "loop.obj")


def test_names_that_no_folder_tells_apart_stay_short() -> None:
    """They had become the path of somebody's disk."""
    short = shortest_paths(["/home/me/i/1.tif", "/home/me/i/1.tiff", "/home/me/i/A.tif", "/home/me/i/a.tif",
                            "/home/me/j/2.tif", "/home/me/k/2.tif"])  # fmt: skip
    assert ["/".join(parts) for parts in short.values()] == ["1", "1", "A", "a", "j/2", "k/2"]
    mixed = shortest_paths(["/home/me/i/1.tif", "/home/me/i/1.tiff", "/home/me/j/1.tif"])
    assert ["/".join(parts) for parts in mixed.values()] == ["i/1", "i/1", "j/1"]
