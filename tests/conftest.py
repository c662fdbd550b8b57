"""What all tests share."""

from __future__ import annotations

from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with test data beside the checkout."""
    folder = CHECKOUT.parent / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("needs the folder `shared` with test data beside the checkout")
    return folder


@pytest.fixture(scope="session")
def block() -> Path:
    """The real drone block that the package brings along."""
    folder = CHECKOUT / "src" / "photoplan" / "demo_block"
    assert folder.is_dir()
    return folder
