"""Restoration filters from files and into files."""

from __future__ import annotations

from pathlib import Path

from photoplan.errors import InputError, UsageError
from photoplan.io.filter_file import FilterEntries, KernelEntry, filter_text, plain_fact, read_filter_file
from photoplan.io.naming import write_atomically
from photoplan.io.product import check_output
from photoplan.quality.restoration.filters import FilterKernel, RestorationFilter


def load_filter(path: Path) -> RestorationFilter:
    """A filter of a file: TOML, or one kernel as rows of numbers."""
    entries = read_filter_file(path)
    try:
        kernels = tuple(FilterKernel(k.values, k.at, k.band) for k in entries.kernels)
        return RestorationFilter(kernels, entries.image_size, entries.description, entries.facts)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def save_filter(path: Path, filter_: RestorationFilter, *, overwrite: bool = False) -> Path:
    """Write a filter as TOML; reading it gives the same values to the last digit."""
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise UsageError(f"{path}: a filter is written as TOML; give a name that ends in .toml")
    check_output(path, overwrite=overwrite)
    write_atomically(path, filter_text(entries_of(filter_)).encode())
    return path


def entries_of(filter_: RestorationFilter) -> FilterEntries:
    """A filter as its file says it."""
    kernels = tuple(KernelEntry(k.values, k.at, k.band) for k in filter_.kernels)
    facts = {str(name): plain_fact(value) for name, value in filter_.facts.items() if value is not None}
    return FilterEntries(kernels, filter_.image_size, filter_.description, facts)
