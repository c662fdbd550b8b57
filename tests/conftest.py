"""What all tests share."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# Before NumPy is loaded: on the small matrices of most tests, threads of linear algebra spend their time waiting for
# each other, all the more with several processes on the same cores (an edge is measured in 0.17 or 0.026 s of CPU).
assert "numpy" not in sys.modules
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Where the surroundings forbid it, every process of tests would compile all sources of photoplan and of the tests anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Invented cases are the same in every run; `--hypothesis-profile search` looks for new ones (`make test-slow`).
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("search", deadline=None, print_blob=True)
settings.load_profile("same")

CHECKOUT = Path(__file__).resolve().parents[1]


#: Files that take longest, the longest first: one that began last would keep one process busy when all others are done.
DEAR = (
    "products/test_every_run.py",
    "kernels/test_rectify.py",
    "terrain/test_fit.py",
    "cli/test_run_faults.py",
    "products/test_restore_design.py",
    "cli/test_adjust_command.py",
    "orientation/test_mark_search.py",
    "terrain/test_build.py",
    "engine/test_tilted.py",
    "terrain/test_gross_errors.py",
    "orientation/test_bundle.py",
    "experiments/test_design_pages.py",
    "cli/test_mtf_command.py",
    "products/test_plausibility.py",
    "products/test_adjust.py",
    "orientation/test_resection.py",
    "cli/test_tie.py",
    "kernels/test_area.py",
    "quality/test_edge_response.py",
    "quality/test_chromatic.py",
    "real/test_brighton.py",
    "cli/test_memory_faults.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Files are handed to processes in the order of the tests, not those with many tests first."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Dear files come first."""
    order = {CHECKOUT / "tests" / name: k for k, name in enumerate(DEAR)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Figures are drawn in full for those tests that look at them; no kernel is compiled twice."""
    from tools import compiled_once, sketched

    sketched.begin(item)
    compiled_once.wait_for_each_other()


@pytest.fixture(scope="module")
def searched_once() -> Iterator[None]:
    """For files whose tests measure edges of the same images again and again."""
    from tools import searched_once

    with searched_once.searched_once():
        yield


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with test data beside the checkout."""
    folder = CHECKOUT.parent / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("needs the folder `shared` with test data beside the checkout")
    return folder


@pytest.fixture(scope="session")
def block() -> Path:
    """The real drone block whose reduced images the package brings along."""
    folder = CHECKOUT / "tests" / "data" / "brighton"
    assert folder.is_dir()
    return folder
