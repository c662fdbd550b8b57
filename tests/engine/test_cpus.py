"""Processors that a container leaves, read from a made-up file system."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from photoplan.engine.executors import available_cpus


@pytest.fixture(autouse=True)
def eight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of eight processors, bound to none of them."""
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)


def system(root: Path, groups: str) -> Path:
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/self/cgroup").write_text(groups)
    return root


def write(root: Path, name: str, text: str) -> None:
    path = root / "sys/fs/cgroup" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_without_a_limit_all_of_the_machine(tmp_path: Path) -> None:
    assert available_cpus(tmp_path) == 8
    root = system(tmp_path, "0::/a\n")
    write(root, "a/cpu.max", "max 100000\n")
    assert available_cpus(root) == 8


def test_affinity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5}, raising=False)
    assert available_cpus(tmp_path) == 2


@pytest.mark.parametrize(("quota", "count"), [("200000 100000", 2), ("250000 100000", 3), ("10000 100000", 1)])
def test_version_2(tmp_path: Path, quota: str, count: int) -> None:
    root = system(tmp_path, "0::/box/inner\n")
    write(root, "box/inner/cpu.max", quota)
    assert available_cpus(root) == count


def test_version_2_the_tightest_group_counts(tmp_path: Path) -> None:
    root = system(tmp_path, "0::/box/inner\n")
    write(root, "box/cpu.max", "300000 100000")
    write(root, "box/inner/cpu.max", "600000 100000")
    assert available_cpus(root) == 3


def test_version_2_inside_a_container(tmp_path: Path) -> None:
    """Its own group is at the top there."""
    root = system(tmp_path, "0::/\n")
    write(root, "cpu.max", "400000 100000")
    assert available_cpus(root) == 4


@pytest.mark.parametrize("folder", ["cpu,cpuacct", "cpu"])
@pytest.mark.parametrize("place", ["docker/0123/", ""])
def test_version_1(tmp_path: Path, folder: str, place: str) -> None:
    root = system(tmp_path, "12:memory:/docker/0123\n4:cpu,cpuacct:/docker/0123\n")
    write(root, f"{folder}/{place}cpu.cfs_quota_us", "150000\n")
    write(root, f"{folder}/{place}cpu.cfs_period_us", "50000\n")
    assert available_cpus(root) == 3
    write(root, f"{folder}/{place}cpu.cfs_quota_us", "-1\n")
    assert available_cpus(root) == 8
