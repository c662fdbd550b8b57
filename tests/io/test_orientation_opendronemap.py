"""reconstruction.json of OpenDroneMap: east, north, up, or UTM minus an offset; told by the data.

The files are made by OpenSfM's own steps (reference, ENU, linear transformation at the reference), written out with
PROJ here and sharing nothing with the reader.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from photoplan.errors import InputError
from photoplan.geometry.crs import topocentric_poses
from photoplan.io.formats import read_orientation, read_orientation_block, write_orientation

ZONE = "EPSG:32616"
UTM = Transformer.from_crs("EPSG:4326", ZONE, always_xy=True)
OFFSET = np.array([698_636.0, 1_558_200.0])
CAMERA = {"c": {"projection_type": "brown", "width": 4000, "height": 3000, "focal_x": 0.7, "focal_y": 0.7}}
CAMERA["c"] |= {"c_x": 0.0, "c_y": 0.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}


def topocentric(lat: float, lon: float) -> Transformer:
    """East, north, up to degrees and height."""
    return Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0=0 "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )


def block(
    n: int = 24, noise: float = 0.5, gps: bool = True, offset: np.ndarray = OFFSET, seed: int = 1
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], dict[str, Any]]:
    """The east-north-up file, the UTM file, and shots.geojson of one block of `n` images over 200 m."""
    rng = np.random.default_rng(seed)
    lon, lat = UTM.transform(*offset, direction="INVERSE")
    degrees = topocentric(lat, lon)

    def utm(p: Any) -> np.ndarray:
        lo, la, h = degrees.transform(*p)
        return np.array([*UTM.transform(lo, la), h])

    q0 = utm((0.0, 0.0, 0.0))
    A = np.column_stack([utm(e) - q0 for e in np.eye(3)])
    b = q0 - [*offset, 0.0]
    local, mapped, features = {}, {}, []
    for k in range(n):
        center = np.array([40.0 * (k % 6) - 100, 50.0 * (k // 6) - 75, 1155.0 + k % 3])
        R = (Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_rotvec(rng.normal(0, 0.05, 3))).as_matrix()
        shot: dict[str, Any] = {"camera": "c", "gps_dop": 5.0}
        if gps:
            shot["gps_position"] = (center + rng.normal(0, noise, 3)).tolist()
        name = f"DJI_{k:02d}.JPG"
        turned = Rotation.from_matrix(R @ np.linalg.inv(A)).as_rotvec()
        there = A @ center + b
        M = Rotation.from_rotvec(turned).as_matrix()
        local[name] = shot | {
            "rotation": Rotation.from_matrix(R).as_rotvec().tolist(),
            "translation": (-R @ center).tolist(),
        }
        mapped[name] = shot | {"rotation": turned.tolist(), "translation": (-M @ there).tolist()}
        place = UTM.transform(*(there[:2] + offset), direction="INVERSE")
        properties = {"filename": name, "camera": "c", "width": 4000, "height": 3000, "rotation": turned.tolist()}
        properties |= {"translation": [*(there[:2] + offset).tolist(), there[2]]}
        point = {"type": "Point", "coordinates": [*place, there[2]]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    common = {"cameras": CAMERA, "points": {}, "reference_lla": {"latitude": lat, "longitude": lon, "altitude": 0.0}}
    return (
        [common | {"shots": local}],
        [common | {"shots": mapped}],
        {"type": "FeatureCollection", "features": features},
    )


def write(folder: Path, content: Any, name: str = "reconstruction.json") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def in_utm(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Positions and rotations in the UTM zone, and the notes."""
    table = read_orientation(path)
    notes = " ".join(table.notes)
    if table.origin is None:
        assert table.crs == ZONE
        return table.centers, table.rotations, notes
    XYZ, axes = topocentric_poses(table.origin, ZONE, table.centers)
    return XYZ, axes @ table.rotations, notes


@pytest.mark.parametrize("seed", range(8))
def test_both_files_of_a_project_give_the_same_poses(tmp_path: Path, seed: int) -> None:
    local, mapped, _ = block(seed=seed)
    a = in_utm(write(tmp_path / "a", local))
    b = in_utm(write(tmp_path / "b", mapped))
    assert "east, north, up" in a[2]
    assert "gps_position of 24 shots" in a[2]
    assert "EPSG:32616 minus the offset 698636, 1558200" in b[2]
    # One linear transformation for all, as OpenDroneMap makes it, is 2 mm off at 100 m.
    np.testing.assert_allclose(a[0], b[0], atol=0.01)
    np.testing.assert_allclose(a[1], b[1], atol=2e-5)


def test_the_wrong_reading_would_have_been_half_a_degree_off() -> None:
    """What the two files differ by: the size of the error where one is read as the other."""
    local, mapped, _ = block()
    turns = []
    for name, shot in local[0]["shots"].items():
        R = [Rotation.from_rotvec(s["rotation"]) for s in (shot, mapped[0]["shots"][name])]
        turns.append(np.degrees((R[0].inv() * R[1]).magnitude()))
    assert 0.4 < min(turns) < max(turns) < 0.5


def test_shots_geojson_tells_without_positions(tmp_path: Path) -> None:
    local, mapped, shots = block(gps=False)
    write(tmp_path, shots, "odm_report/shots.geojson")
    for content, is_map in ((local, False), (mapped, True)):
        path = write(tmp_path, content, "opensfm/reconstruction.json")
        table = read_orientation(path)
        assert (table.crs == ZONE) is is_map
        assert f"shots.geojson has {'the same' if is_map else 'other'} rotations" in table.notes[0]
    direct = read_orientation(tmp_path / "odm_report" / "shots.geojson")
    np.testing.assert_allclose(table.centers, direct.centers, atol=1e-6)
    np.testing.assert_allclose(table.rotations, direct.rotations, atol=1e-9)


def test_the_topocentric_file_beside_tells(tmp_path: Path) -> None:
    local, mapped, _ = block(gps=False)
    assert read_orientation(write(tmp_path, local, "reconstruction.topocentric.json")).crs is None
    assert read_orientation(write(tmp_path, mapped)).crs == ZONE
    assert read_orientation(write(tmp_path, local)).crs is None


def test_what_nothing_tells_is_refused(tmp_path: Path) -> None:
    for content in (*block(gps=False)[:2], block(n=6, noise=3.0)[0]):
        with pytest.raises(InputError, match=r"nothing tells whether .*shots\.geojson"):
            read_orientation(write(tmp_path, content))


def test_a_reference_off_whole_metres_is_opensfm(tmp_path: Path) -> None:
    table = read_orientation(write(tmp_path, block(gps=False, offset=OFFSET + 0.37)[0]))
    assert table.crs is None
    assert "east, north, up about reference_lla" in table.notes[0]


def test_on_the_central_meridian_both_readings_are_one_up_to_scale(tmp_path: Path) -> None:
    """There the convergence is nothing; the map's scale of 0.9996 is still 4 cm in 100 m."""
    local, mapped, _ = block(offset=np.array([500_000.0, 1_558_200.0]), noise=0.02)
    assert read_orientation(write(tmp_path, local)).crs is None
    assert read_orientation(write(tmp_path, mapped)).crs == ZONE


def change(content: list[dict[str, Any]], turn: float = 0.0, shift: float = 0.0) -> list[dict[str, Any]]:
    """Poses in axes that are turned (degrees) and shifted (metres)."""
    T = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    for shot in content[0]["shots"].values():
        R = Rotation.from_rotvec(shot["rotation"]).as_matrix()
        center = T @ (-R.T @ np.array(shot["translation"])) + [shift, 0, 0]
        shot["rotation"] = Rotation.from_matrix(R @ T.T).as_rotvec().tolist()
        shot["translation"] = (-R @ T.T @ center).tolist()
    return content


@pytest.mark.parametrize("offset", [OFFSET, OFFSET + 0.37])
@pytest.mark.parametrize(("turn", "shift", "says"), [(0.0, 300.0, "lie 300 m"), (20.0, 0.0, r"turned by (19\.5|20)")])
def test_what_is_neither_is_refused(tmp_path: Path, offset: np.ndarray, turn: float, shift: float, says: str) -> None:
    path = write(tmp_path, change(block(offset=offset)[0], turn, shift))
    with pytest.raises(InputError, match=rf"poses do not fit gps_position of the shots: .*{says}"):
        read_orientation(path)


def test_contradictions_are_refused(tmp_path: Path) -> None:
    local, mapped, _ = block(noise=0.2)
    path = write(tmp_path, mapped, "reconstruction.topocentric.json")
    with pytest.raises(InputError, match=r"contradicts itself \(its name says topocentric: east, north, up; gps_pos"):
        read_orientation(path)
    assert read_orientation(write(tmp_path, local, "reconstruction.topocentric.json")).crs is None


def test_positions_are_carried_over(tmp_path: Path) -> None:
    """A file that is written again is told as before, since it states the same positions."""
    first = read_orientation_block(write(tmp_path, block()[0]))
    again = tmp_path / "again.json"
    write_orientation(first, again, "opensfm")
    content = json.loads(again.read_text())[0]["shots"]["DJI_03.JPG"]
    before = block()[0][0]["shots"]["DJI_03.JPG"]
    np.testing.assert_allclose(content["gps_position"], before["gps_position"], atol=1e-6)
    assert read_orientation(again).origin == first.table.origin
    assert first.table.positions is not None
    assert first.table.positions.shape == (24, 3)
