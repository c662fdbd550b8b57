"""Views along a path, and pairs of views: the cameras, what is kept of an earlier run, films, and the base of pairs."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Said, inside
from tools.small_block import X0, Y0, Block, write_block

from photoplan.errors import UsageError
from photoplan.products.view.camera import open_view_ground, view_camera
from photoplan.products.view.lines import at_equal_steps, cameras
from photoplan.products.view.make import eyes
from photoplan.requests.view import CameraRequest, Stereo

LOOK = ("--size", 64, 48, "--samples", 1, "--content", "shade", "-q")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Block:
    return write_block(tmp_path_factory.mktemp("sequence") / "block", project=False)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A line of 100 m to the east, then 50 m to the north, in the CRS of the block."""
    line = {"type": "LineString", "coordinates": [[X0 - 80, Y0], [X0 + 20, Y0], [X0 + 20, Y0 + 50]]}
    feature = {"type": "Feature", "properties": {}, "geometry": line}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    (tmp_path / "path.geojson").write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    return tmp_path / "path.geojson"


def pixels(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        return file.read()


def sequence(small: Block, path: Path, out: Path, *words: object) -> Said:
    return inside("view", "sequence", small.terrain, "--path", path, "--height", 40, *LOOK, *words, "-o", out)


def test_stations_and_directions_of_a_line() -> None:
    """Every 50 m from the first vertex on; the direction is that from the station before to the one behind."""
    places = at_equal_steps(np.array([(0.0, 0, 5), (100, 0, 5), (100, 50, 10)]), 50.0)
    np.testing.assert_allclose(places, [(0, 0, 5), (50, 0, 5), (100, 0, 5), (100, 50, 10)])
    made = cameras(CameraRequest(position=(0, 0), azimuth=0.0, height=2.0), places, along=True)
    np.testing.assert_allclose([c.azimuth for c in made], [90, 90, 45, 0])
    np.testing.assert_allclose([c.altitude for c in made], [7, 7, 7, 12])


def test_pictures_are_those_of_single_views_and_are_kept(small: Block, path: Path, tmp_path: Path) -> None:
    out = tmp_path / "frames"
    said = sequence(small, path, out, "--step", 75, "--look-at", X0 + 60, Y0 + 90)
    assert said.code == 0, said.err
    assert sorted(p.name for p in out.glob("*.png")) == [f"frame_0000{k}.png" for k in (1, 2, 3)]
    one = tmp_path / "one.png"
    stand = ("--from", X0 - 5, Y0, "--height", 40, "--look-at", X0 + 60, Y0 + 90)
    assert inside("view", small.terrain, *stand, *LOOK, "-o", one).code == 0
    np.testing.assert_array_equal(pixels(one), pixels(out / "frame_00002.png"))
    (out / "frame_00003.png").unlink()
    before = (out / "frame_00001.png").stat().st_mtime_ns
    said = sequence(small, path, out, "--step", 75, "--look-at", X0 + 60, Y0 + 90, "--json")
    assert said.code == 0 and json.loads(said.out)["kept"] == 2
    assert (out / "frame_00001.png").stat().st_mtime_ns == before and (out / "frame_00003.png").is_file()
    said = sequence(small, path, out, "--step", 75)  # ahead: another view stands there
    assert said.code == 2 and "exists already" in said.err


def test_tints_do_not_change_from_picture_to_picture(small: Block, tmp_path: Path) -> None:
    """Two stations that see different heights: their common range colours both."""
    (tmp_path / "p.csv").write_text(f"x,y\n{X0 - 80},{Y0}\n{X0 - 80},{Y0}\n")
    (tmp_path / "q.csv").write_text(f"x,y\n{X0 - 80},{Y0}\n{X0 + 200},{Y0 + 150}\n")
    words = ("--height", 15, "--fov", 20, "--azimuth", 80, "--pitch", -20, "--size", 64, 48, "--samples", 1, "-q")
    for name in "pq":
        more = ("--path", tmp_path / f"{name}.csv", "--content", "tint", "-o", tmp_path / name)
        assert inside("view", "sequence", small.terrain, *words, *more).code == 0
    first, second = (pixels(tmp_path / name / "frame_00001.png").astype(int) for name in "pq")
    kept = pixels(tmp_path / "p" / "frame_00002.png")
    np.testing.assert_array_equal(kept, first)
    assert np.abs(first - second).max() > 0  # another range of heights


def test_a_film_needs_ffmpeg(small: Block, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    words = ("--step", 100, "--video", tmp_path / "film.mp4", "--rate", 10)
    said = sequence(small, path, tmp_path / "f", *words)
    assert said.code == 2 and "needs ffmpeg" in said.err and not (tmp_path / "f").exists()
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\necho "$@" > "$last"\n')
    program.chmod(0o755)
    said = sequence(small, path, tmp_path / "f", *words)
    assert said.code == 0, said.err
    told = (tmp_path / "film.mp4").read_text()
    assert "-framerate 10" in told and "frame_%05d.png" in told and "-frames:v 2" in told
    program.write_text("#!/bin/sh\necho no such encoder >&2\nexit 1\n")
    said = sequence(small, path, tmp_path / "f", *words, "--overwrite")
    assert said.code == 1 and "no such encoder" in said.err and (tmp_path / "film.mp4").read_text() == told


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg on the PATH")
def test_ffmpeg_joins_the_pictures_of_this_run(small: Block, path: Path, tmp_path: Path) -> None:
    """A longer run before left more pictures in the folder: they are told, and are not part of the film."""
    out, film = tmp_path / "f", tmp_path / "film.mp4"
    words = ("--look-at", X0 + 60, Y0 + 90, "--size", 63, 47)
    assert sequence(small, path, out, "--step", 25, *words).code == 0
    words = (*words[:3], *LOOK[3:-1], "--size", 63, 47, "--step", 75, "--video", film, "--rate", 10, "--overwrite")
    said = inside("view", "sequence", small.terrain, "--path", path, "--height", 40, *words, "-o", out)
    assert said.code == 0, said.err
    assert "holds 4 more pictures" in said.err and "frame_00004.png" in said.err
    # Decoded again: three pictures, sides made even, alike but for what H.264 loses.
    ffmpeg = ["ffmpeg", "-y", "-loglevel", "error", "-i", str(film), str(tmp_path / "again_%d.png")]
    subprocess.run(ffmpeg, check=True)
    assert len([*tmp_path.glob("again_*.png")]) == 3
    again, frame = pixels(tmp_path / "again_3.png"), pixels(out / "frame_00003.png")
    assert again.shape == (3, 48, 64)
    assert np.abs(again[:, :47, :63].astype(int) - frame).mean() < 12


def test_what_makes_no_path_is_refused(small: Block, path: Path, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text(f"x,y\n{X0},{Y0}\n")
    for words, why in (
        ((path,), "needs a --step"),
        ((path, "--step", 0), "--step 0"),
        ((path, "--step", 50, "--from", 1, 2), "those of its --path"),
        ((path, "--step", 50, "--stereo", "anaglyph"), "one --base"),
        ((tmp_path / "one.csv",), "1 stations"),
        ((tmp_path / "one.csv", "--step", 5), "have no --step"),
    ):
        said = sequence(small, words[0], tmp_path / "no", *words[1:])
        assert said.code == 2 and why in said.err, said.err
    (tmp_path / "far.csv").write_text("x,y\n0,0\n1,1\n")
    said = sequence(small, tmp_path / "far.csv", tmp_path / "no", "--azimuth", 0)
    assert said.code == 3 and "picture 1 of 2" in said.err
    assert not (tmp_path / "no").exists()


def test_a_pair_is_two_views_a_base_apart(small: Block, tmp_path: Path) -> None:
    """Beside each other the pictures of both eyes; as anaglyph the brightness of the left one in red."""
    stand = ("--from", X0 - 80, Y0 - 60, "--altitude", 160, "--azimuth", 30, "--pitch", -20)
    for how, name in (("side-by-side", "both"), ("anaglyph", "red")):
        said = inside(
            "view", small.terrain, *stand, *LOOK, "--stereo", how, "--base", 4, "-o", tmp_path / f"{name}.png"
        )
        assert said.code == 0, said.err
    ways = np.array([np.cos(np.radians(30)), -np.sin(np.radians(30))])
    single = []
    for side in (-2, 2):
        x, y = (np.array([X0 - 80, Y0 - 60]) + side * ways).tolist()
        one = tmp_path / f"{side}.png"
        assert inside("view", small.terrain, "--from", repr(x), repr(y), *stand[3:], *LOOK, "-o", one).code == 0
        single.append(pixels(one).astype(int))
    both, red = pixels(tmp_path / "both.png").astype(int), pixels(tmp_path / "red.png").astype(int)
    assert both.shape == (3, 48, 128)
    assert np.abs(both - np.concatenate(single, axis=2)).max() <= 1
    assert np.abs(red[1:] - single[1][1:]).max() <= 1
    assert np.abs(red[0] - np.tensordot((0.299, 0.587, 0.114), single[0], 1)).max() <= 2
    assert np.abs(single[0] - single[1]).max() > 20
    record = json.loads((tmp_path / "both.run.json").read_text())
    assert record["view"]["stereo"] == "side-by-side" and record["view"]["base_m"] == 4


def test_the_camera_of_an_image_makes_a_pair_with_its_lens(tmp_path: Path) -> None:
    small = write_block(tmp_path / "block")
    ground = open_view_ground(small.project)
    camera = view_camera(CameraRequest(image=ground.named.images[0].name), ground)
    left, right = (view_camera(eye, ground).target for eye in eyes(camera, 10.0))
    apart = right.center - left.center
    assert np.linalg.norm(apart) == pytest.approx(10.0)
    np.testing.assert_allclose((left.center + right.center) / 2, camera.target.center, atol=1e-6)
    # What the left eye sees at a pixel, the image sees from half a base further on.
    pixel = np.array([[30.0, 20.0, 80.0]])
    np.testing.assert_allclose(camera.target.to_ground(pixel) - left.to_ground(pixel), [apart / 2], atol=1e-5)
    out = tmp_path / "pair.png"
    words = ("--camera", camera.request.image, "--content", "shade", "--samples", 1, "--stereo", "anaglyph", "-q")
    said = inside("view", small.project, *words, "-o", out)
    assert said.code == 0, said.err
    red, green, _ = pixels(out).astype(int)
    assert (red != green).mean() > 0.3


def test_parallax_is_camera_constant_times_base_by_depth(small: Block) -> None:
    ground = open_view_ground(small.terrain)
    request = CameraRequest(position=(X0, Y0), altitude=300.0, azimuth=70.0, pitch=-30.0, roll=20.0, curvature="none")
    camera = view_camera(request, ground)
    left, right = (view_camera(eye, ground).target for eye in eyes(camera, 6.0))
    point = np.array([X0 + 200.0, Y0 + 50.0, 110.0])
    (x, y, depth), (u, v, other) = left.to_view(point), right.to_view(point)
    focal = 600 / np.tan(np.radians(30))
    assert x - u == pytest.approx(focal * 6.0 / depth, rel=1e-9)
    assert (y, depth) == (pytest.approx(v), pytest.approx(other))
    with pytest.raises(UsageError, match="needs a plane picture"):
        eyes(view_camera(CameraRequest(position=(X0, Y0), azimuth=0.0, panorama="cylinder"), ground), 1.0)
    assert Stereo("anaglyph").stated(100.0).base == 3.3
