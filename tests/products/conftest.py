"""A small block for tests of whole products."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from tools.small_block import Block, write_block


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Block:
    """The small block; nobody changes it."""
    return write_block(tmp_path_factory.mktemp("pristine") / "block")


@pytest.fixture
def small(pristine: Block, tmp_path: Path) -> Block:
    """A copy of the small block to change."""
    return Block(Path(shutil.copytree(pristine.folder, tmp_path / "block")))
