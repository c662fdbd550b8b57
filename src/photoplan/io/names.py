"""Names from tables made safe: for files that are read, and for files that are written."""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path

from photoplan.errors import InputError

_ABSOLUTE = re.compile(r"(?<![\w./<\\-])(?:/|[A-Za-z]:[/\\])[^\s<>\"'&;:,()\[\]]+[/\\][^\s<>\"'&;:,()\[\]]+")

#: Bytes of a stem at most; file systems allow 255 for a name, and products add a few suffixes.
MAX_BYTES = 120

#: And of a whole name.
MAX_NAME = 240

#: Device names that Windows reserves, with or without a suffix.
_RESERVED = {"con", "prn", "aux", "nul", "clock$"} | {f"{d}{i}" for d in ("com", "lpt") for i in "0123456789¹²³"}

# Two or more characters and a colon: `https:`, `NETCDF:`, `zip+file:`; a single letter is a Windows drive.
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+._-]+:")


def safe_stem(name: str) -> str:
    """File stem for the products of an image called `name`.

    Folders and the suffix of a raster format are dropped; letters and digits of any script, ``-``, ``_`` and inner
    ``.`` stay; everything else becomes ``_``. Reserved device names get a trailing ``_``; stems of more than 120 bytes
    are cut and end with eight digits of a hash of the whole name, so that they stay different.
    """
    text = unicodedata.normalize("NFC", name)
    stem = match_key(name)
    stem = "".join(c if c.isalnum() or c in "-_." else "_" for c in stem).strip(". ").lstrip("-")
    if not any(c.isalnum() for c in stem):
        raise InputError(f"image name {name!r} holds no letter or digit; give the image a name to write products under")
    if stem.split(".")[0].casefold() in _RESERVED:
        head, dot, rest = stem.partition(".")
        stem = f"{head}_{dot}{rest}"
    if len(stem.encode()) > MAX_BYTES:
        mark = hashlib.sha256(text.encode()).hexdigest()[:8]
        stem = stem.encode()[: MAX_BYTES - 9].decode(errors="ignore") + "_" + mark
    return stem


def file_in(folder: Path, name: str) -> Path:
    """Path of a file that is called `name`, wherever the name comes from; it cannot lead out of the folder."""
    name = name if isinstance(name, str) else ""  # what comes from JSON may be anything
    stem, dot, _ = name.partition(".")
    if (
        len(name.encode(errors="replace")) > MAX_NAME
        or not name
        or name.strip(". ") != name
        or not all(c.isalnum() or c in "-_. " for c in name)
        or f"{stem}{dot}".rstrip(".").casefold() in _RESERVED
    ):
        raise InputError(
            f"{name[:200]!r} cannot be the name of a file; letters, digits, '-', '_' and inner '.' are accepted, up to "
            f"{MAX_NAME} bytes"
        )
    return folder / name


def unique_stems(names: Iterable[str]) -> dict[str, str]:
    """File stem of every name; no two names have the same one.

    Names with one base name get their folders in front, as many as tell them apart, then a number. Capitals are ignored
    in the comparison, since common file systems ignore them.
    """
    stems = {name: safe_stem(name) for name in names}
    taken: set[str] = set()
    for name, short in shortest_paths(stems).items():
        stem = safe_stem("_".join(short)) if len(short) > 1 else stems[name]
        plain, number = stem, 2
        while stem.casefold() in taken:
            stem, number = f"{plain}_{number}", number + 1
        taken.add(stem.casefold())
        stems[name] = stem
    return stems


def shortest_paths(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The last folders and the base name of every name: as few folders as tell it from the others.

    Names that no folder tells apart keep what is the same.
    """
    parts = {name: name_parts(name) for name in names}
    short = dict.fromkeys(parts, 1)
    while True:
        groups: dict[tuple[str, ...], list[str]] = {}
        for name, count in short.items():
            groups.setdefault(tuple(p.casefold() for p in parts[name][-count:]), []).append(name)
        longer = [
            n
            for group in groups.values()
            if len({tuple(p.casefold() for p in parts[name]) for name in group}) > 1
            for n in group
            if short[n] < len(parts[n])
        ]
        if not longer:
            return {name: parts[name][-count:] for name, count in short.items()}
        for name in longer:
            short[name] += 1


def name_parts(name: str) -> tuple[str, ...]:
    """Folders and base name of an image; no drive, no ``.`` and ``..``, no raster suffix."""
    folders = re.split(r"[/\\]", unicodedata.normalize("NFC", name.strip()))[:-1]
    return (*(f for f in folders if f not in ("", ".", "..") and not re.fullmatch(r"[A-Za-z]:", f)), match_key(name))


class ImageNames:
    """Images found by any spelling of their names: the one notion of which two names are one image.

    Names are compared without folder and raster suffix. If several images have one base name, the folders decide, from
    the last one upwards, then capitals, then the suffix.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = set(names := list(names))
        self._by_key: dict[str, list[str]] = {}
        for name in dict.fromkeys(names):
            self._by_key.setdefault(match_key(name).casefold(), []).append(name)

    def find(self, name: str) -> str | None:
        """The image that is meant; None if no image has the base name."""
        if name in self._names:
            return name
        known = self._by_key.get(match_key(name).casefold(), [])
        scores = [_likeness(name, other) for other in known]
        fitting = [other for other, score in zip(known, scores) if score == max(scores)]
        if len(fitting) > 1:
            raise InputError(
                f"image {name!r} may be {' or '.join(map(repr, fitting[:4]))}; write its name with the folder"
            )
        return fitting[0] if fitting else None

    def match(self, given: Sequence[str]) -> list[str | None]:
        """The image of each of several names, no two of which are one image; None if no image has the base name."""
        found = [self.find(name) for name in given]
        best: dict[str, int] = {}
        for k, known in enumerate(found):
            if known is None:
                continue
            first = best.setdefault(known, k)
            if first == k:
                continue
            scores = _likeness(given[first], known), _likeness(given[k], known)
            if scores[0] == scores[1]:
                raise InputError(
                    f"{given[first]!r} and {given[k]!r} are both image {known!r} by the base name; rename one, or "
                    "write the folder in all names"
                )
            lost, best[known] = (first, k) if scores[1] > scores[0] else (k, first)
            found[lost] = None
        return found


def _likeness(name: str, other: str) -> tuple[int, bool, bool, bool]:
    """How well two names of one base name fit: equal folders, no folder that differs, capitals, suffix."""
    one, two = name_parts(name)[:-1], name_parts(other)[:-1]
    pairs = list(zip(reversed([p.casefold() for p in one]), reversed([p.casefold() for p in two])))
    equal = next((k for k, (a, b) in enumerate(pairs) if a != b), len(pairs))
    ends = [re.split(r"[/\\]", n)[-1] for n in (name, other)]
    alike = match_key(name) == match_key(other)
    return equal, equal == len(pairs), alike, ends[0].casefold() == ends[1].casefold()


def same_images(names: Iterable[str]) -> dict[str, str]:
    """Each name of a file with the spelling that the file first gives the image.

    An image may be written with or without folders and suffix; names whose folders differ are different images.
    """
    groups: dict[str, dict[str, tuple[str, ...]]] = {}
    for name in dict.fromkeys(names):
        groups.setdefault(match_key(name), {})[name] = name_parts(name)
    found: dict[str, str] = {}
    for group in groups.values():
        parts = set(group.values())
        # The full spellings: no other one goes on to the left of them.
        full = [p for p in parts if not any(q != p and q[-len(p) :] == p for q in parts)]
        first: dict[tuple[str, ...], str] = {}
        for name, own in group.items():
            fitting = [p for p in full if p[-len(own) :] == own]
            if len(fitting) > 1:
                raise InputError(
                    f"image {name!r} may be {' or '.join(repr('/'.join(p)) for p in sorted(fitting)[:4])}; write its "
                    "name with the folder"
                )
            found[name] = first.setdefault(fitting[0], name)
    return found


def match_key(name: str) -> str:
    """What two names of one image have in common: no folder, no raster suffix, Unicode composed."""
    last = re.split(r"[/\\]", unicodedata.normalize("NFC", name.strip()))[-1]
    return re.sub(r"\.(tiff?|jpe?g|png|jp2|j2k|img|vrt|ecw|sid|ntf|nitf|bmp|pix|dng|raw)$", "", last, flags=re.I)


def check_input_name(text: str) -> str:
    """Refuse an input that is not a plain path: GDAL's virtual systems, URLs, driver prefixes, inline documents."""
    plain = text.strip().replace("\\", "/")
    reason = None
    if not plain:
        reason = "it is empty"
    elif any(ord(c) < 32 for c in text):
        reason = "it holds control characters"
    elif re.match(r"/+vsi", plain, flags=re.I):
        reason = "GDAL's virtual file systems are not read"
    elif _SCHEME.match(plain):
        reason = "addresses and driver prefixes are not read"
    elif plain.startswith(("<", "{")):
        reason = "inline documents are not read"
    if reason:
        raise InputError(f"input {text[:200]!r}: {reason}; give the path of a file on this computer")
    return text


def resolve_input(folder: Path, text: str) -> Path:
    """Absolute path of an input, relative ones from `folder`; virtual paths are refused after resolving too."""
    path = Path(check_input_name(text)).expanduser()
    full = Path((folder / path).absolute())
    try:
        full = Path(*full.parts).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # links that lead to themselves, names no file can have
        raise InputError(f"input {text[:200]!r}: leads to no file ({error}); give the path of a file") from error
    check_input_name(str(full))
    return full


def relative_path(file: Path, folder: Path) -> str:
    """Path of a file as the project file states it: from the project's folder, where there is a way."""
    # The folder of the file is resolved, not the file: a link keeps its own name, and so do the products.
    target = file.parent.resolve() / file.name
    try:
        return Path(os.path.relpath(target, folder.absolute().resolve())).as_posix()
    except ValueError:  # another drive
        return target.as_posix()


def stated_path(file: Path | str, folder: Path) -> str:
    """Path of a file as records and reports in a folder state it: from there; its name on another drive."""
    try:
        return Path(os.path.relpath(Path(file).absolute(), folder.absolute())).as_posix()
    except ValueError:
        return Path(file).name


def stated_text(text: str, folder: Path) -> str:
    """Text for files in a folder, in which absolute paths are written from there: it shows nothing of a disk."""
    for here in dict.fromkeys((folder.absolute(), folder.resolve())):
        for up, place in enumerate([here, *here.parents][:-1]):
            pattern = rf"(?<![\w./\\-]){re.escape(str(place))}(?:[/\\]|(?=[\s\"'<>,;:)]|$))"
            text = re.sub(pattern, "../" * up, text) if up else re.sub(pattern, _inside, text)
    for found in sorted(set(_ABSOLUTE.findall(text)), key=len, reverse=True):
        if os.path.lexists(found):
            text = text.replace(found, stated_path(found, folder))
    return text


def _inside(found: re.Match[str]) -> str:
    return "" if found[0][-1] in "/\\" else "."
