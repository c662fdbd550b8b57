"""The drone block as its user has it: images that state position and gimbal angles, and how far a result is from it."""

from __future__ import annotations

import csv
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from photoplan.cameras.base import project as project_points
from photoplan.geometry.pose import rotation_from_angles
from photoplan.io.project.file import load_project
from photoplan.project.scene import open_scene

#: The strip that was flown the other way: its images were turned by 180° when they were reduced, its gimbal was not.
TURNED = range(24, 30)
SIZE = (2000, 1125)
_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
    'drone-dji:AbsoluteAltitude="+{GPSAltitude}" drone-dji:GpsLatitude="{GPSLatitude}" '
    'drone-dji:GpsLongitude="{GPSLongitude}" drone-dji:GimbalRollDegree="+0.00" '
    'drone-dji:GimbalYawDegree="{yaw:+.2f}" drone-dji:GimbalPitchDegree="{GimbalPitchDegree}"/></rdf:RDF></x:xmpmeta>'
)


def write_images(images: Path, exif: Path, folder: Path) -> None:
    """Copies of the images that state again, as XMP, what the drone had written into the originals."""
    folder.mkdir(parents=True, exist_ok=True)
    with exif.open() as file:
        for row in csv.DictReader(file):
            name = Path(row["SourceFile"]).stem
            yaw = float(row["GimbalYawDegree"]) + (180.0 if int(name[-4:]) in TURNED else 0.0)
            packet = b"http://ns.adobe.com/xap/1.0/\0" + _XMP.format(yaw=yaw, **row).encode()
            jpeg = (images / f"{name}.jpg").read_bytes()
            segment = b"\xff\xe1" + struct.pack(">H", len(packet) + 2) + packet
            (folder / f"{name}.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])


@dataclass(frozen=True)
class Distance:
    """How a block's orientations differ from reference ones."""

    shift: NDArray[np.float64]
    """Mean of reference minus adjusted positions, (3,), metres."""
    scale: float
    turned: float
    """Degrees by which the block as a whole is turned."""
    positions: NDArray[np.float64]
    """What a similarity leaves of the positions, (n, 3), metres."""
    angles: NDArray[np.float64]
    """What it leaves of the rotations, about the camera's axes, (n, 3), degrees."""

    def __str__(self) -> str:
        p, a = (np.sqrt((v**2).mean(axis=0)) for v in (self.positions, self.angles))
        return (
            f"shift {np.round(self.shift, 3)} m, scale {self.scale:.5f}, turned {self.turned:.3f}°; after similarity "
            f"rms {np.round(p, 3)} m, {np.round(a, 3)}°, worst {np.abs(self.positions).max():.3f} m, "
            f"{np.abs(self.angles).max():.3f}°"
        )


def distance(adjusted: Path, reference: Path) -> Distance:
    """Compare the orientations of two project files, image by image."""
    mine, theirs = load_project(adjusted), load_project(reference)
    names = [image.name for image in theirs.images]
    A, B = (np.array([p.image(n).pose_numbers[0] for n in names]) for p in (mine, theirs))
    R_A, R_B = (
        np.array([rotation_from_angles(np.radians(p.image(n).pose_numbers[1])) for n in names]) for p in (mine, theirs)
    )
    a, b = A - A.mean(axis=0), B - B.mean(axis=0)
    U, size, Vt = np.linalg.svd(b.T @ a)  # Umeyama 1991
    sign = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    R = (U * sign) @ Vt
    scale = float((size * sign).sum() / (a**2).sum())
    left = np.swapaxes(R @ R_A, 1, 2) @ R_B
    turns = np.stack([left[:, 2, 1] - left[:, 1, 2], left[:, 0, 2] - left[:, 2, 0], left[:, 1, 0] - left[:, 0, 1]], 1)
    return Distance(
        (B - A).mean(axis=0),
        scale,
        float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))),
        b - scale * a @ R.T,
        np.degrees(turns / 2),
    )


def write_control(folder: Path, reference: Path, heights: Path, count: int = 12, seed: int = 3) -> tuple[Path, Path]:
    """Tables of image points and ground points as a survey would give them, every third one a check point.

    Places are spread over ground that is level within 0.15 m over 1.4 m; noise is 0.5 pixels and 3 cm.
    """
    random, truth = np.random.default_rng(seed), load_project(reference)
    with rasterio.open(heights) as file:
        Z, to_ground = file.read(1, masked=True).filled(np.nan), file.transform
    windows = sliding_window_view(Z, (7, 7))
    row, col = (k + 3 for k in np.nonzero(np.ptp(windows, axis=(2, 3)) < 0.15))
    XYZ = np.stack([to_ground.c + (col + 0.5) * to_ground.a, to_ground.f + (row + 0.5) * to_ground.e, Z[row, col]], 1)
    seen, places = {}, {}
    for image in truth.images:
        camera = open_scene(truth, image.name).camera
        xy = places[image.name] = project_points(camera, XYZ)
        seen[image.name] = ((xy > 40) & (xy < np.array(SIZE) - 40)).all(axis=1)
    often = np.flatnonzero(sum(s.astype(int) for s in seen.values()) >= 2)
    chosen = [int(often[np.argmin(XYZ[often, 0])])]
    while len(chosen) < count:
        gap = np.min([np.hypot(*(XYZ[often, :2] - XYZ[k, :2]).T) for k in chosen], axis=0)
        chosen.append(int(often[np.argmax(gap)]))
    measured, control = ["point,image,x,y"], ["name,x,y,z,role"]
    for k, at in enumerate(chosen):
        X, Y, height = XYZ[at] + random.normal(0, 0.03, 3)
        control.append(f"P{k},{X:.3f},{Y:.3f},{height:.3f},{'check' if k % 3 == 2 else 'control'}")
        for name in places:
            if seen[name][at]:
                x, y = places[name][at] + random.normal(0, 0.5, 2)
                measured.append(f"P{k},{name},{x:.2f},{y:.2f}")
    folder.mkdir(parents=True, exist_ok=True)
    for name, lines in (("measured.csv", measured), ("control.csv", control)):
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder / "measured.csv", folder / "control.csv"
