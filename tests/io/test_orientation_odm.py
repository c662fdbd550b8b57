"""OpenDroneMap's shots.geojson, by hand after what its files hold; and OpenSfM's reconstruction.json written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation
from tools.format_examples import assert_same, below, block_of, frame, pixels, round_trip, with_table

from photoplan.errors import InputError
from photoplan.geometry.crs import topocentric_poses
from photoplan.io.formats import orientation_format, read_orientation_block, write_orientation

CAMERA = {"projection_type": "brown", "width": 2048, "height": 1536, "focal_x": 0.57, "focal_y": 0.571}
CAMERA |= {"c_x": 0.003, "c_y": -0.002, "k1": -0.02, "k2": 0.01, "p1": 1e-3, "p2": -5e-4, "k3": 2e-3}
UTM = Transformer.from_crs("EPSG:4326", "EPSG:32616", always_xy=True)


def shots(**change: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """A FeatureCollection, and rotation and centre of its images."""
    features, poses = [], {}
    for k in range(4):
        lon, lat, h = -87.1597 + 2e-4 * k, 14.0883 - 1e-4 * k, 1155.0 + k
        x, y = UTM.transform(lon, lat)
        # Straight down with the image's top to the north, then some turning.
        R = Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec([0.1 * k, -0.05, 0.7 * k])
        poses[f"DJI_{k}.JPG"] = R.as_matrix(), np.array([x, y, h])
        properties = {"filename": f"DJI_{k}.JPG", "camera": "v2 dji", "focal": 0.57, "width": 2048, "height": 1536}
        properties |= {"translation": [x, y, h], "rotation": R.as_rotvec().tolist(), "capture_time": 1.5e9} | change
        point = {"type": "Point", "coordinates": [lon, lat, h]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    return {"type": "FeatureCollection", "features": features}, poses


def test_shots_see_the_documented_pixels(tmp_path: Path) -> None:
    content, poses = shots()
    (tmp_path / "odm_report").mkdir()
    path = tmp_path / "odm_report" / "shots.geojson"
    path.write_text(json.dumps(content))
    (tmp_path / "cameras.json").write_text(json.dumps({"v2 dji": CAMERA}))
    block = read_orientation_block(path)
    assert block.table.crs == "EPSG:32616"
    assert any("agree with longitude and latitude in EPSG:32616" in n for n in block.table.notes)
    c = CAMERA
    for k, (R, centre) in enumerate(poses.values()):
        for X in centre + np.random.default_rng(k).uniform([-40, -40, -110], [40, 40, -90], (10, 3)):
            x, y, z = R @ (X - centre)
            x, y = x / z, y / z
            r2 = x * x + y * y
            g = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3
            xd = x * g + 2 * c["p1"] * x * y + c["p2"] * (r2 + 2 * x * x)
            yd = y * g + c["p1"] * (r2 + 2 * y * y) + 2 * c["p2"] * x * y
            u = (c["focal_x"] * xd + c["c_x"]) * 2048 + 2047 / 2
            v = (c["focal_y"] * yd + c["c_y"]) * 2048 + 1535 / 2
            np.testing.assert_allclose(pixels(block, X, k), [u, v], atol=1e-6)


def test_without_cameras_json_there_is_no_camera(tmp_path: Path) -> None:
    path = tmp_path / "shots.geojson"
    path.write_text(json.dumps(shots()[0]))
    block = read_orientation_block(path)
    assert block.cameras == {}
    assert block.sizes["DJI_0.JPG"] == (2048, 1536)
    assert any("no lens" in n for n in block.table.notes)


def test_the_zone_is_never_guessed(tmp_path: Path) -> None:
    content = shots()[0]
    for feature in content["features"]:
        feature["properties"]["translation"][0] += 3.0
    path = tmp_path / "shots.geojson"
    path.write_text(json.dumps(content))
    table = read_orientation_block(path).table
    assert table.crs is None
    assert any("declare the CRS" in n for n in table.notes)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"filename": None}, "feature 1 states no filename"),
        ({"rotation": [1, 2]}, r"shot 'DJI_0\.JPG': rotation.*3 numbers"),
        ({"translation": None}, r"shot 'DJI_0\.JPG': translation"),
        ({"width": "x"}, "width and height"),
    ],
)
def test_broken_shots_are_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    path = tmp_path / "shots.geojson"
    path.write_text(json.dumps(shots(**change)[0]))
    with pytest.raises(InputError, match=says):
        read_orientation_block(path, format="odm")
    path.write_text("[]")
    with pytest.raises(InputError, match=r"not a shots\.geojson"):
        read_orientation_block(path, format="odm")


def test_shots_round_trip(tmp_path: Path) -> None:
    block = block_of({"a": frame()}, crs="EPSG:32632")
    again = round_trip(block, tmp_path / "shots.geojson", "odm")
    assert_same(again, replace(block, cameras={}))
    assert again.table.crs == "EPSG:32632"
    kinds = [x.kind for x in orientation_format("odm").losses(block_of({"a": frame()}, crs="EPSG:25832"))]
    assert kinds == ["camera", "crs"]
    with pytest.raises(InputError, match="state the CRS"):
        write_orientation(block_of({"a": frame()}), tmp_path / "b.geojson", "odm")


@pytest.mark.parametrize("lens", ["none", "brown", "brown with affinity", "opencv", "fisheye"])
def test_reconstruction_written_sees_the_same_pixels(tmp_path: Path, lens: str) -> None:
    """Projected with OpenSfM's definition from the written numbers, and with photoplan's camera from the block."""
    block = with_table(block_of({"a": frame(lens)}, middle=(30.0, -20.0, 90.0)), origin=(46.84, -91.99, 150.0))
    path = tmp_path / "reconstruction.json"
    write_orientation(block, path, "opensfm")
    content = json.loads(path.read_text())[0]
    c = content["cameras"]["a"]
    for k, (name, shot) in enumerate(content["shots"].items()):
        assert name == block.table.images[k].name
        R, t = Rotation.from_rotvec(shot["rotation"]).as_matrix(), np.array(shot["translation"])
        ground = below(block, k, 10)
        p = ground @ R.T + t
        x, y = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2]
        if lens == "fisheye":
            r = np.hypot(x, y)
            q = np.arctan(r)
            d = q * (1 + c["k1"] * q**2 + c["k2"] * q**4 + c["k3"] * q**6 + c["k4"] * q**8) / r
            xd, yd = x * d, y * d
        else:
            r2 = x * x + y * y
            g = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3
            xd = x * g + 2 * c["p1"] * x * y + c["p2"] * (r2 + 2 * x * x)
            yd = y * g + c["p1"] * (r2 + 2 * y * y) + 2 * c["p2"] * x * y
        side = max(c["width"], c["height"])
        u = (c["focal_x"] * xd + c["c_x"]) * side + (c["width"] - 1) / 2
        v = (c["focal_y"] * yd + c["c_y"]) * side + (c["height"] - 1) / 2
        np.testing.assert_allclose(pixels(block, ground, k), np.stack([u, v], axis=1), atol=1e-8)
    assert_same(block, read_orientation_block(path))


@pytest.mark.parametrize(("crs", "x"), [("EPSG:32632", 5e5), ("EPSG:25832", 3.2e5), ("EPSG:2154", 7e5)])
def test_reconstruction_of_a_map_comes_back(tmp_path: Path, crs: str, x: float) -> None:
    y = 6.6e6 if crs == "EPSG:2154" else 5.3e6
    block = block_of({"a": frame("opencv")}, middle=(x, y, 900.0), crs=crs, height_system="ellipsoidal")
    again = round_trip(block, tmp_path / "reconstruction.json", "opensfm")
    assert again.table.origin is not None
    XYZ, axes = topocentric_poses(again.table.origin, crs, again.table.centers)
    # Map coordinates of millions of metres have a spacing of 1e-9 m, and the way goes through degrees.
    np.testing.assert_allclose(XYZ, block.table.centers, rtol=0, atol=2e-8)
    np.testing.assert_allclose(axes @ again.table.rotations, block.table.rotations, rtol=0, atol=1e-9)
    assert list(orientation_format("opensfm").losses(block)) == []


def test_what_a_reconstruction_cannot_hold(tmp_path: Path) -> None:
    losses = orientation_format("opensfm").losses
    assert [x.kind for x in losses(block_of({"a": frame("rational")}, crs="EPSG:32632"))] == ["lens", "height_system"]
    with pytest.raises(InputError, match="state the CRS"):
        write_orientation(block_of({"a": frame()}), tmp_path / "r.json", "opensfm")
    with pytest.raises(InputError, match="none is given"):
        write_orientation(block_of({}, crs="EPSG:32632"), tmp_path / "r.json", "opensfm")
