"""OpenSfM's reconstruction.json, against numbers worked out from its documented definition."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from photoplan.errors import InputError
from photoplan.io.formats import read_orientation

LLA = {"latitude": 46.84, "longitude": -91.99, "altitude": 150.0}


def write(folder: Path, content: Any, name: str = "reconstruction.json") -> Path:
    path = folder / name
    path.write_text(json.dumps(content))
    return path


def reconstruction(shots: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"cameras": {}, "shots": shots, "points": {}, "reference_lla": LLA, **more}


def test_a_vertical_image_by_hand(tmp_path: Path) -> None:
    # Camera axes x right, y down, z forwards; looking straight down with x to the east, y down is south and z is down:
    # R_camera_world = diag(1, -1, -1), a half turn about x. At E 10, N 20, U 80: t = -R (10, 20, 80) = (-10, 20, 80).
    shot = {"camera": "c", "rotation": [np.pi, 0, 0], "translation": [-10.0, 20.0, 80.0]}
    table = read_orientation(write(tmp_path, [reconstruction({"a.jpg": shot})]))
    assert table.origin == (46.84, -91.99, 150.0)
    assert table.crs is None
    np.testing.assert_allclose(table.centers[0], [10, 20, 80], atol=1e-12)
    # In our axes (y up, z towards the viewer) this is the image without any rotation.
    np.testing.assert_allclose(table.rotations[0], np.eye(3), atol=1e-12)
    assert table.images[0].camera == "c"
    assert table.images[0].name == "a.jpg"


def test_any_pose_projects_as_the_documentation_says(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    shots, poses = {}, []
    for k in range(20):
        R, t = Rotation.random(random_state=k), rng.normal(size=3) * 30
        shots[f"{k}.jpg"] = {"camera": "c", "rotation": R.as_rotvec().tolist(), "translation": t.tolist()}
        poses.append((R.as_matrix(), t))
    table = read_orientation(write(tmp_path, [reconstruction(shots)]))
    X = rng.normal(size=3) * 100
    for k, (R, t) in enumerate(poses):
        x, y, z = R @ X + t
        ours = table.rotations[k].T @ (X - table.centers[k])
        np.testing.assert_allclose(ours, [x, -y, -z], atol=1e-9)


def test_several_reconstructions_and_the_origin_beside(tmp_path: Path) -> None:
    shot = {"camera": "c", "rotation": [0.1, 0, 0], "translation": [0, 0, 0]}
    two = [reconstruction({"a": shot, "b": shot}), reconstruction({"c": shot})]
    table = read_orientation(write(tmp_path, two))
    assert [i.name for i in table.images] == ["a", "b", "c"]
    assert "2 separate reconstructions (2, 1 images)" in table.notes[0]
    two[1]["reference_lla"] = {**LLA, "latitude": 47.0}
    with pytest.raises(InputError, match="2 different origins"):
        read_orientation(write(tmp_path, two))
    nowhere = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    with pytest.raises(InputError, match=r"latitude 0, longitude 0: .* not georeferenced"):
        read_orientation(write(tmp_path, [reconstruction({"a": shot}) | {"reference_lla": nowhere}]))
    del two[0]["reference_lla"]
    with pytest.raises(InputError, match="not georeferenced"):
        read_orientation(write(tmp_path, two[:1]))
    write(tmp_path, LLA, "reference_lla.json")
    assert read_orientation(write(tmp_path, two[:1])).origin == (46.84, -91.99, 150.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rotation": [0, 0]}, "shot 'a': rotation: .* 3 numbers"),
        ({"rotation": None}, "rotation"),
        ({"translation": [0, 0, "x"]}, "translation: 'x' given"),
    ],
)
def test_broken_shots_are_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    shot = {"camera": "c", "rotation": [0.1, 0, 0], "translation": [0, 0, 0], **change}
    with pytest.raises(InputError, match=says):
        read_orientation(write(tmp_path, [reconstruction({"a": shot})]))


@pytest.mark.parametrize("content", [{}, [], [1], [{"cameras": {}}], [reconstruction({})]])
def test_other_json_is_refused(tmp_path: Path, content: Any) -> None:
    with pytest.raises(InputError, match=r"reconstruction\.json"):
        read_orientation(write(tmp_path, content))


def test_a_camera_without_a_form_costs_its_images(tmp_path: Path) -> None:
    shot = {"rotation": [0.1, 0, 0], "translation": [0, 0, 0]}
    one = {"projection_type": "perspective", "width": 600, "height": 400, "focal": 0.8, "k1": 0, "k2": 0}
    cameras = {"c": one, "d": one | {"projection_type": "spherical"}}
    for used, left in (("c", ["a", "b"]), ("d", ["a"])):
        shots = {"a": shot | {"camera": "c"}, "b": shot | {"camera": used}}
        table = read_orientation(write(tmp_path, [reconstruction(shots) | {"cameras": cameras}]))
        assert [i.name for i in table.images] == left
        assert any("left out" in note and "spherical" in note for note in table.notes) is (used == "d")
    with pytest.raises(InputError, match="'spherical' is not supported"):
        read_orientation(write(tmp_path, [reconstruction({"b": shot | {"camera": "d"}}) | {"cameras": cameras}]))
