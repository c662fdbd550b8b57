"""Which image file belongs to which line of an orientation table, and to which camera."""

from __future__ import annotations

import glob
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.camera.file import CameraFile
from photoplan.io.names import ImageNames, check_input_name
from photoplan.io.orientation.table import OrientationTable, OrientedImage

#: Names that are listed; the rest is counted.
SHOWN = 5


@dataclass(frozen=True)
class Unoriented:
    """An image of which nothing is known but its file."""

    name: str
    fiducials: None = None


def image_files(patterns: tuple[str, ...]) -> list[Path]:
    """Files of all patterns, each once, in the order of the patterns and sorted within."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        check_input_name(pattern)
        # A file is taken by its name even where the name holds brackets.
        names = [pattern] if Path(pattern).is_file() else sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207
        for name in names:
            if Path(name).is_file():
                found[Path(name).absolute()] = None
    if not found:
        hint = "; to take all files of a folder write FOLDER/*.tif" if any(Path(p).is_dir() for p in patterns) else ""
        raise InputError(f"images {' '.join(patterns)!r}: no file matches the pattern{hint}")
    return list(found)


def match_images(
    files: list[Path], table: OrientationTable
) -> tuple[list[tuple[Path, OrientedImage | Unoriented]], list[Path], list[str]]:
    """Image files with their orientation, files without, and names without a file.

    See `photoplan.io.names.ImageNames` for how names are compared.
    """
    by_name = {image.name: image for image in table.images}
    try:
        found = ImageNames(by_name).match([file.as_posix() for file in files])
    except InputError as error:
        raise InputError(f"{table.file}: {error}; or narrow the pattern of image files") from None
    taken = set(found)
    pairs: list[tuple[Path, OrientedImage | Unoriented]] = []
    pairs += [(file, by_name[name]) for file, name in zip(files, found) if name is not None]
    lonely = [file for file, name in zip(files, found) if name is None]
    if not pairs:
        raise InputError(
            f"no image file is named in {table.file}: files are {some([f.name for f in files])}; "
            f"names there are {some([i.name for i in table.images])}"
        )
    return pairs, lonely, [name for name in by_name if name not in taken]


def camera_by_size(file: Path, size: tuple[int, int], cameras: CameraFile) -> str:
    """Name of the camera of an image of which no table tells: the only one, or the only one of its size."""
    if len(cameras.cameras) == 1:
        return next(iter(cameras.cameras))
    of_size = [n for n, c in cameras.cameras.items() if c.size == size and c.fiducial_system is None]
    if len(of_size) == 1:
        return of_size[0]
    known = ", ".join(map(repr, cameras.cameras))
    raise InputError(
        f"{cameras.file} describes {len(cameras.cameras)} cameras ({known}), and {len(of_size)} of them have the "
        f"{size[0]} × {size[1]} px of {file}; make a project with one camera's file, or give an orientation table with "
        "a column called camera"
    )


def camera_name(image: OrientedImage, cameras: CameraFile, table: Path) -> str:
    """Name of an image's camera: as the table states it, or the only one."""
    known = ", ".join(map(repr, cameras.cameras))
    if image.camera is not None:
        if image.camera in cameras.cameras:
            return image.camera
        raise InputError(
            f"{table}{f':{image.line}' if image.line else ''}: image {image.name!r} names camera {image.camera!r}; "
            f"{cameras.file} describes {known}; use one name in both files"
        )
    if len(cameras.cameras) == 1:
        return next(iter(cameras.cameras))
    raise InputError(
        f"{cameras.file} describes {len(cameras.cameras)} cameras ({known}), and {table} does not say which image has "
        "which; add a column called camera"
    )


def some(names: list[str]) -> str:
    """The first names, and how many more there are."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more
