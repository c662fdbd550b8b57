"""What is thinned in `make test`; all of it is in `make test-slow`, with the same bounds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import settings


def thinned(name: str, few: int, all_of_them: int) -> pytest.MarkDecorator:
    """Parametrise a test by its number of runs; the few are the first of all."""
    return pytest.mark.parametrize(name, [few, pytest.param(all_of_them, marks=pytest.mark.slow)])


def some(values: Iterable[Any], *places: int) -> list[Any]:
    """Values of parameters of which those at some places are in `make test`, the others in `make test-slow` alone.

    A tuple is a set of values for as many names; where it is the value of one name it stands in a tuple of its own.
    """

    def slow(value: Any) -> Any:
        if isinstance(value, type(pytest.param())):
            return value
        return pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.slow)

    return [value if place in places else slow(value) for place, value in enumerate(values)]


def examples(few: int, all_of_them: int) -> int:
    """Number of invented cases: the few in `make test`, all where new ones are looked for (`make test-slow`)."""
    return few if settings.default.derandomize else all_of_them
