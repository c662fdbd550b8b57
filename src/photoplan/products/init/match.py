"""Which image file belongs to which line of an orientation table, and to which camera."""

from __future__ import annotations

import glob
from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.camera.file import CameraFile
from photoplan.io.names import check_input_name, match_key
from photoplan.io.orientation.table import OrientationTable, OrientedImage

#: Names that are listed; the rest is counted.
SHOWN = 5


@dataclass(frozen=True)
class Unoriented:
    """An image of which nothing is known but its file."""

    name: str
    fiducials: None = None


def image_files(patterns: tuple[str, ...]) -> list[Path]:
    """Files of all patterns, each once, in the order of the patterns and sorted within.

    Raises
    ------
    InputError
        No file matches.
    """
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

    Names are compared without folder and raster suffix, and without regard to capitals where that leaves one choice.

    Raises
    ------
    InputError
        Nothing matches, or two files or two lines have one base name.
    """
    by_key: dict[str, OrientedImage] = {}
    for image in table.images:
        key = match_key(image.name)
        if key in by_key:
            raise InputError(
                f"{table.file}: {by_key[key].name!r} and {image.name!r} are one image by their base name; rename one"
            )
        by_key[key] = image
    loose: dict[str, list[str]] = {}
    for key in by_key:
        loose.setdefault(key.casefold(), []).append(key)
    pairs: list[tuple[Path, OrientedImage | Unoriented]] = []
    lonely: list[Path] = []
    taken: dict[str, Path] = {}
    for file in files:
        key = match_key(file.name)
        if key not in by_key and len(loose.get(key.casefold(), [])) == 1:
            key = loose[key.casefold()][0]
        if key not in by_key:
            lonely.append(file)
            continue
        if key in taken:
            raise InputError(_one_name(taken[key], file))
        taken[key] = file
        pairs.append((file, by_key[key]))
    if not pairs:
        raise InputError(
            f"no image file is named in {table.file}: files are {some([f.name for f in files])}; "
            f"names there are {some([i.name for i in table.images])}"
        )
    return pairs, lonely, [image.name for key, image in by_key.items() if key not in taken]


def unoriented(files: list[Path]) -> list[tuple[Path, OrientedImage | Unoriented]]:
    """All image files, under their base names.

    Raises
    ------
    InputError
        Two files have one base name.
    """
    taken: dict[str, Path] = {}
    for file in files:
        key = match_key(file.name)
        if key in taken:
            raise InputError(_one_name(taken[key], file))
        taken[key] = file
    return [(file, Unoriented(key)) for key, file in taken.items()]


def _one_name(first: Path, second: Path) -> str:
    return (
        f"{first} and {second} have one base name, so their products would too; "
        "rename one of them or narrow the pattern"
    )


def camera_by_size(file: Path, size: tuple[int, int], cameras: CameraFile) -> str:
    """Name of the camera of an image of which no table tells: the only one, or the only one of its size.

    Raises
    ------
    InputError
        Several cameras are described, and the size does not decide.
    """
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
    """Name of an image's camera: as the table states it, or the only one.

    Raises
    ------
    InputError
        The table names a camera that is not described, or none where there are several.
    """
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
