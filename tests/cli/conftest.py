"""What the tests of the command line share: a small block, its undisturbed products, the command."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from tools.command import OPTIONS, Here, Undisturbed, inside
from tools.small_block import Block, write_block


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Block:
    """The small block; nobody changes it."""
    return write_block(tmp_path_factory.mktemp("pristine") / "block")


@pytest.fixture(scope="session")
def undisturbed(pristine: Block, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """Products of the small block, made by one worker."""
    folder = tmp_path_factory.mktemp("undisturbed")
    said = inside("ortho", pristine.project, *OPTIONS, "--workers", 1, "--output", folder, "--json")
    assert said.code == 0, said.err
    return Undisturbed(folder, said)


@pytest.fixture
def small(pristine: Block, tmp_path: Path) -> Block:
    """A copy of the small block to spoil."""
    return Block(Path(shutil.copytree(pristine.folder, tmp_path / "block")))


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    """The command, called inside this process."""
    return Here(capsys)
