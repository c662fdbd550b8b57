"""Names from tables made safe: for files that are read, and for files that are written."""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path

from photoplan.errors import InputError

#: Bytes of a stem at most; file systems allow 255 for a name, and products add a few suffixes.
MAX_BYTES = 120

#: Device names that Windows reserves, with or without a suffix.
_RESERVED = {"con", "prn", "aux", "nul", "clock$"} | {f"{d}{i}" for d in ("com", "lpt") for i in "0123456789¹²³"}

# Two or more characters and a colon: `https:`, `NETCDF:`, `zip+file:`; a single letter is a Windows drive.
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+._-]+:")


def safe_stem(name: str) -> str:
    """File stem for the products of an image called `name`.

    Folders and the suffix of a raster format are dropped; letters and digits of any script, ``-``, ``_`` and inner
    ``.`` stay; everything else becomes ``_``. Reserved device names get a trailing ``_``; stems of more than 120 bytes
    are cut and end with eight digits of a hash of the whole name, so that they stay different.

    Raises
    ------
    InputError
        Nothing usable is left of the name.
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


def unique_stems(names: Iterable[str]) -> dict[str, str]:
    """Stem of every name; two names that would write the same files are an error before any work.

    Case is ignored in the comparison, since common file systems ignore it.

    Raises
    ------
    InputError
        Two names share a stem; both are named.
    """
    stems: dict[str, str] = {}
    first: dict[str, str] = {}
    for name in names:
        stem = safe_stem(name)
        key = stem.casefold()
        if key in first:
            raise InputError(
                f"images {first[key]!r} and {name!r} would both write {stem!r}; rename one of them in the project file"
            )
        first[key] = name
        stems[name] = stem
    return stems


def match_key(name: str) -> str:
    """What two names of one image have in common: no folder, no raster suffix, Unicode composed."""
    last = re.split(r"[/\\]", unicodedata.normalize("NFC", name.strip()))[-1]
    return re.sub(r"\.(tiff?|jpe?g|png|jp2|j2k|img|vrt|ecw|sid|ntf|nitf|bmp|pix|dng|raw)$", "", last, flags=re.I)


def check_input_name(text: str) -> str:
    """Refuse an input that is not a plain path: GDAL's virtual systems, URLs, driver prefixes, inline documents.

    Raises
    ------
    InputError
        The text is not the path of a file on this computer.
    """
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
