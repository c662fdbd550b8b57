"""The camera in the forms that other programs use: OpenCV's, and Brown's with y down.

Both describe the same pixels as photoplan's camera, or there is no such form and None comes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from photoplan.cameras.lenses import Brown, Fisheye, NoLens, OpenCV
from photoplan.errors import InputError
from photoplan.io.camera.frame import frame_in_pixels
from photoplan.io.camera.model import CameraEntry, InPixels
from photoplan.io.orientation.block import Loss, OrientationBlock
from photoplan.io.project.model import lens_of


@dataclass(frozen=True)
class OpenCVForm:
    """A camera as OpenCV knows it, y down."""

    size: tuple[int, int]
    focal: tuple[float, float]
    """fx, fy, pixels."""
    point: tuple[float, float]
    """Column and row of the principal point, (0, 0) the centre of the upper-left pixel."""
    fisheye: bool
    k: tuple[float, ...]
    """k1–k6 of the rational lens, or k1–k4 of the fisheye."""
    p: tuple[float, float] = (0.0, 0.0)

    @property
    def rational(self) -> bool:
        """Whether the denominator k4–k6 is used."""
        return not self.fisheye and any(self.k[3:])


def opencv_form(camera: CameraEntry) -> OpenCVForm | None:
    """OpenCV's form of a camera; None for film, and for lenses that OpenCV does not have."""
    if camera.pixels is None:
        return None
    (fx, fy), lens = camera.pixels.focal, lens_of(camera)
    k: tuple[float, ...] = (0.0,) * 6
    p, fisheye = (0.0, 0.0), False
    if isinstance(lens, OpenCV):
        k, p = (lens.k1, lens.k2, lens.k3, lens.k4, lens.k5, lens.k6), (lens.p1, lens.p2)
    elif isinstance(lens, Fisheye):
        k, fisheye = (lens.k1, lens.k2, lens.k3, lens.k4), True
    elif isinstance(lens, Brown) and lens.b2 == 0 and lens.k4 == 0:
        # Brown's y points up. The affinity is a second focal length.
        k, p = (lens.k1, lens.k2, lens.k3, 0.0, 0.0, 0.0), (0.0 - lens.p2, lens.p1)
        fx *= 1.0 + lens.b1
    elif not isinstance(lens, NoLens):
        return None
    return OpenCVForm(size=camera.pixels.size, focal=(fx, fy), point=camera.pixels.point, fisheye=fisheye, k=k, p=p)


def opencv_losses(block: OrientationBlock, *, rational: bool = True, fisheye: bool = True) -> list[Loss]:
    """What of a block's cameras a format with OpenCV's lenses cannot hold."""
    lost = []
    for name, camera in block.cameras.items():
        if camera.pixels is None:
            lost.append(Loss("camera", f"no camera {name!r}: film has no pixels of its own"))
            continue
        form = opencv_form(camera)
        if form is None:
            lost.append(Loss("lens", f"no lens of type {camera.lens.type} as camera {name!r} has it"))
        elif form.rational and not rational:
            lost.append(Loss("lens", f"no k4 to k6 (camera {name!r})"))
        elif form.fisheye and not fisheye:
            lost.append(Loss("lens", f"no fisheye lens (camera {name!r})"))
    return lost


@dataclass(frozen=True)
class AgisoftForm:
    """A camera as Agisoft's programs know it, y down; everything in pixels."""

    size: tuple[int, int]
    f: float
    offset: tuple[float, float]
    """cx, cy: principal point minus the middle of the image."""
    k: tuple[float, float, float, float]
    p: tuple[float, float]
    b: tuple[float, float]
    """b1, b2, pixels."""
    fisheye: bool = False


def agisoft_form(camera: CameraEntry) -> AgisoftForm | None:
    """Agisoft's form of a camera; None for film, and for lenses that it does not have."""
    if camera.pixels is None:
        return None
    (fx, fy), lens = camera.pixels.focal, lens_of(camera)
    k, p, b, fisheye = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), (0.0, 0.0), False
    if isinstance(lens, OpenCV) and not (lens.k4 or lens.k5 or lens.k6):
        k, p = (lens.k1, lens.k2, lens.k3, 0.0), (lens.p2, lens.p1)
    elif isinstance(lens, Fisheye):
        k, fisheye = (lens.k1, lens.k2, lens.k3, lens.k4), True
    elif isinstance(lens, Brown):
        k, p, b = (lens.k1, lens.k2, lens.k3, lens.k4), (lens.p1, 0.0 - lens.p2), (lens.b1, 0.0 - lens.b2)
    elif not isinstance(lens, NoLens):
        return None
    # x fx (1 + b1) = x (f + B1) with f = fy: square pixels of the height, and their affinity.
    in_pixels = fx * (1.0 + b[0]) - fy if b[0] or fx != fy else 0.0, fx * b[1]
    (col, row), size = camera.pixels.point, camera.pixels.size
    offset = col - (size[0] - 1) / 2, row - (size[1] - 1) / 2
    return AgisoftForm(size=size, f=fy, offset=offset, k=k, p=p, b=in_pixels, fisheye=fisheye)


def frame_camera(form: OpenCVForm | AgisoftForm, where: str) -> CameraEntry:
    """The description of a camera in one of the two forms; `where` begins messages."""
    if isinstance(form, OpenCVForm):
        (fx, fy), point = form.focal, form.point
        names = ("k1", "k2", "k3", "k4", "k5", "k6")
        lens: dict[str, Any] = {"type": "opencv_fisheye" if form.fisheye else "opencv", **dict(zip(names, form.k))}
        if not form.fisheye:
            lens |= {"p1": form.p[0], "p2": form.p[1]}
    else:
        point = (form.size[0] - 1) / 2 + form.offset[0], (form.size[1] - 1) / 2 + form.offset[1]
        lens, (fx, fy) = _agisoft_lens(form, where)
    if lens["type"] != "opencv_fisheye" and not any(v for key, v in lens.items() if key[0] in "kpb"):
        lens = {"type": "none"}
    return frame_in_pixels(InPixels(form.size, (fx, fy), point), lens, where)


def _agisoft_lens(form: AgisoftForm, where: str) -> tuple[dict[str, Any], tuple[float, float]]:
    k = {f"k{i + 1}": v for i, v in enumerate(form.k)}
    b1, b2 = form.b
    if form.fisheye:
        if form.p != (0.0, 0.0) or b2 != 0:
            raise InputError(
                f"{where}: a fisheye with p1, p2 or b2 is not supported; fix them to 0, align and export again"
            )
        return {"type": "opencv_fisheye", **k}, (form.f + b1, form.f)
    if form.f <= 0:
        raise InputError(f"{where}: f = {form.f}; a positive number of pixels is needed")
    p1, p2 = form.p
    lens = {"type": "brown", "y_axis": "down", **k, "p1": p1, "p2": p2, "b1": b1 / form.f, "b2": b2 / form.f}
    return lens, (form.f, form.f)
