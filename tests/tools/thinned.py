"""Simulations that are thinned in `make test`; all of their runs are made by `make test-slow`, with the same bounds."""

from __future__ import annotations

import pytest


def thinned(name: str, few: int, all_of_them: int) -> pytest.MarkDecorator:
    """Parametrise a test by its number of runs; the few are the first of all."""
    return pytest.mark.parametrize(name, [few, pytest.param(all_of_them, marks=pytest.mark.slow)])
