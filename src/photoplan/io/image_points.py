"""Image points in text tables: point, image, column and row, with or without standard deviations.

With a header that names the columns, or without one in the order ``point image x y [sigma | sigma_x sigma_y]``. Points
are in pixels, (0, 0) the centre of the upper-left pixel. One image may be written with or without folder and suffix.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photoplan.cameras.observed import ImagePoints
from photoplan.errors import InputError
from photoplan.io.names import ImageNames, same_images
from photoplan.io.tables import Columns, Dialect, Table, read_table, write_table

_ROLES = {
    "point": ("point", "name", "point_id", "id", "gcp", "track"),
    "image": ("image", "photo", "file", "filename", "image_name", "cliche"),
    "x": ("x", "column", "col", "x_px", "column_px"),
    "y": ("y", "row", "line", "y_px", "row_px"),
    "sigma": ("sigma", "sigma_px"),
    "sigma_x": ("sigma_x", "sigma_col", "sigma_column"),
    "sigma_y": ("sigma_y", "sigma_row", "sigma_line"),
}
_NEEDED = ("point", "image", "x", "y")
_COLUMNS = Columns(
    roles=_ROLES, needed=_NEEDED, orders=(_NEEDED, (*_NEEDED, "sigma"), (*_NEEDED, "sigma_x", "sigma_y"))
)


#: Part of the measurements that may be of a point in an image in which it is measured once more.
_FEW = 0.02


def read_image_points(
    path: Path, *, columns: str | None = None, decimal_comma: bool = False, doubtful: list[str] | None = None
) -> ImagePoints:
    """Measured image points of a table."""
    table = read_table(Path(path), _COLUMNS, Dialect(columns, decimal_comma=decimal_comma))
    points, images = table.names("point"), table.names("image")
    spelled = same_images(images)
    point_at = {name: k for k, name in enumerate(dict.fromkeys(points))}
    image_at = {name: k for k, name in enumerate(dict.fromkeys(spelled.values()))}
    image = np.array([image_at[spelled[name]] for name in images], np.int64)
    point = np.array([point_at[name] for name in points], np.int64)
    found = table.numbers("x", "y"), _sigma(table)
    keep = _once(table, image * len(point_at) + point, (points, images), doubtful)
    return ImagePoints(
        images=tuple(image_at),
        points=tuple(point_at),
        image=image[keep],
        point=point[keep],
        xy=found[0][keep],
        sigma=found[1][keep],
    )


def _sigma(table: Table) -> np.ndarray:
    sigma = np.stack([table.first_known(role, "sigma") for role in ("sigma_x", "sigma_y")], axis=1)
    bad = np.flatnonzero((sigma <= 0).any(axis=1))
    if len(bad):
        k = int(bad[0])
        raise InputError(f"{table.where(k)}: standard deviation {sigma[k].tolist()} px; it must be positive")
    return sigma


def _once(
    table: Table, key: np.ndarray, names: tuple[Sequence[str], Sequence[str]], doubtful: list[str] | None
) -> np.ndarray:
    """Measurements of a point in an image that are the only ones, (n,): of several nothing says which is right."""
    _, of, count = np.unique(key, return_inverse=True, return_counts=True)
    twice = np.asarray(count[of.reshape(-1)] > 1)
    if twice.any():
        first, second = np.flatnonzero(key == key[np.flatnonzero(twice)[0]])[:2]
        what = (
            f"{table.where(second)}: point {names[0][second]!r} is measured in image {names[1][second]!r} in line "
            f"{table.lines[first]} already"
        )
        if doubtful is None or twice.sum() > max(2.0, _FEW * len(key)) or len(key) < 20:
            raise InputError(f"{what}; keep one of the measurements")
        doubtful.append(f"{what}; {int(twice.sum())} such measurements take no part, as nothing says which is right")
    return ~twice


def named_as(points: ImagePoints, names: Sequence[str]) -> tuple[ImagePoints, tuple[str, ...]]:
    """The measurements with the images' names written as in `names`, and the images that are not among these.

    See `photoplan.io.names.ImageNames`. Images that are not known keep their name.
    """
    try:
        found = ImageNames(names).match(points.images)
    except InputError as error:
        raise InputError(f"image points: {error}") from None
    # An image that is not known must not take the name of one that is.
    taken = set(names)
    renamed = [
        known or (f"{image} (unknown)" if image in taken else image) for known, image in zip(found, points.images)
    ]
    unknown = tuple(image for known, image in zip(found, points.images) if known is None)
    return ImagePoints(
        images=tuple(renamed),
        points=points.points,
        image=points.image,
        point=points.point,
        xy=points.xy,
        sigma=points.sigma,
    ), unknown


def write_image_points(path: Path, points: ImagePoints) -> None:
    """Write measurements as a table with header; it appears complete or not at all.

    Standard deviations are written where one is known.
    """
    stated = bool(np.isfinite(points.sigma).any())
    rows = []
    for k in range(len(points)):
        row = [points.points[points.point[k]], points.images[points.image[k]], *(f"{v:.10g}" for v in points.xy[k])]
        if stated:
            row += ["" if np.isnan(v) else f"{v:.6g}" for v in points.sigma[k]]
        rows.append(row)
    write_table(path, [*_NEEDED, *(("sigma_x", "sigma_y") if stated else ())], rows)
