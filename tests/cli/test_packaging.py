"""What a user installs: size of the included block, licences of others' data, and an end without noise."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]


def test_the_included_block_is_small() -> None:
    block = CHECKOUT / "src" / "photoplan" / "demo_block"
    assert sum(file.stat().st_size for file in block.rglob("*")) <= 6_000_000
    assert len(list((block / "images").iterdir())) == 18


def test_notices_name_files_that_are_there() -> None:
    for notice, root in (("NOTICE", "src"), ("tests/NOTICE", ".")):
        named = re.findall(r"^\* (\S+):", (CHECKOUT / notice).read_text("utf-8"), re.M)
        assert named
        for path in named:
            assert (CHECKOUT / root / path).exists(), (notice, path)


def test_every_licence_file_of_the_package_is_there() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text("utf-8"))["project"]
    assert all((CHECKOUT / file).is_file() for file in project["license-files"])
    # Data of others in the wheel bring their own licence text.
    assert (CHECKOUT / "src" / "photoplan" / "demo_block" / "LICENSE").is_file()


def test_rasters_are_closed_before_the_interpreter_ends(block: Path) -> None:
    """Left open, they make "Error in sys.excepthook" on Python 3.12 and newer."""
    code = (
        "import atexit, sys\n"
        "left = []\n"
        "atexit.register(lambda: print(len(left[0].open)))\n"  # registered first, it runs last
        "from pathlib import Path\n"
        "from photoplan.io import disk\n"
        "left.append(disk._handles)\n"
        "disk.handle(Path(sys.argv[1]), 'JPEG')\n"
        "print(len(disk._handles.open))\n"
    )
    image = sorted((block / "images").iterdir())[0]
    said = subprocess.run([sys.executable, "-c", code, str(image)], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["1", "0"]


def test_the_archive_of_sources_holds_tests_and_pages_and_metadata_say_where_it_runs() -> None:
    grafted = set(re.findall(r"^graft (\S+)", (CHECKOUT / "MANIFEST.in").read_text("utf-8"), re.M))
    assert {"tests", "docs", "examples"} <= grafted and all((CHECKOUT / name).is_dir() for name in grafted)
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text("utf-8"))["project"]
    classifiers = "\n".join(project["classifiers"])
    assert "Programming Language :: Python :: 3.11" in classifiers and "Operating System ::" in classifiers
    assert project["authors"]
    # 2.6 and 2.7 do not work.
    assert "pydantic>=2.8" in project["dependencies"]
