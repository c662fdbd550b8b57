"""Correction files of light fall-off as models."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.fall_off_file import read_fall_off_entry
from photoplan.quality.camera.fall_off_model import FallOffModel


def read_fall_off(path: Path) -> FallOffModel:
    """The model of a correction file; `photoplan.quality.fall_off_model.correct_fall_off` applies it.

    Raises
    ------
    InputError
        The file cannot be used.
    """
    entry = read_fall_off_entry(path)
    try:
        return FallOffModel(
            entry.size,
            entry.principal_point_px,
            entry.camera_constant_px,
            tuple((term.n, term.m) for term in entry.terms),
            tuple(term.coefficient for term in entry.terms),
            entry.dark_dn,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
