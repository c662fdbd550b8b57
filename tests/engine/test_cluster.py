"""A Dask cluster: asked before it works, results by files where both sides see them, told when it is gone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.events import Told

from photoplan.engine import executors as clusters
from photoplan.engine.executors import (
    Answer,
    Cluster,
    Parcel,
    Question,
    RemoteJob,
    Workers,
    answer,
    executor_factory,
    judge,
    open_workers,
    run_tiles,
    source_fingerprint,
)
from photoplan.errors import InputError, ResourceError, UsageError

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs distributed")


def versions() -> dict[str, str]:
    return {"photoplan": "1", "GDAL": "3.9", "numpy": np.__version__}


def local(workers: int) -> Any:
    import distributed  # half a second of each collection

    return distributed.LocalCluster(
        n_workers=workers, threads_per_worker=3, processes=False, dashboard_address=None, protocol="tcp"
    )


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Two workers of three threads inside this process."""
    with local(2) as cluster:
        yield cluster.scheduler_address


def picture(task: int) -> Any:
    return np.full(1000, task)


#: Tasks of `first_alone` wait for it.
GO = threading.Event()


def first_alone(task: int) -> int:
    if task:
        GO.wait(300)
    return task


class TestAnswers:
    OWN = Answer("abc", {"photoplan": "1", "GDAL": "3.9", "numba": "0.60"}, (), "t")

    def test_the_same_everywhere_needs_no_word(self) -> None:
        assert judge("tcp://a:1", self.OWN, {"w1": self.OWN, "w2": self.OWN}) == []

    def test_another_photoplan_is_refused(self) -> None:
        """Its version may even be the same."""
        with pytest.raises(UsageError, match=r"tcp://a:1: worker w2 has another photoplan \(1, here is 1\)"):
            judge("tcp://a:1", self.OWN, {"w1": self.OWN, "w2": replace(self.OWN, fingerprint="abd")})
        with pytest.raises(UsageError, match=r"worker w1 has another photoplan .cannot be asked: no module"):
            judge("tcp://a:1", self.OWN, {"w1": ImportError("no module photoplan.engine.executors")})

    def test_another_gdal_is_named_once(self) -> None:
        other = replace(self.OWN, versions={**self.OWN.versions, "GDAL": "3.8"})
        (note,) = judge("tcp://a:1", self.OWN, {"w1": other, "w2": other})
        assert "workers have GDAL 3.8, here is 3.9" in note

    def test_inputs_that_are_not_seen_are_refused(self) -> None:
        blind = replace(self.OWN, unseen=("/data/a.tif", "/data/b.tif"))
        with pytest.raises(InputError, match=r"worker w1 does not see /data/a\.tif and 1 more inputs"):
            judge("tcp://a:1", self.OWN, {"w1": blind})

    def test_what_a_process_says(self, tmp_path: Path) -> None:
        (tmp_path / "here").write_text("token")
        question = Question(versions, (str(tmp_path / "here"), str(tmp_path / "gone")))
        said = answer(question, str(tmp_path / "here"))
        assert said == Answer(source_fingerprint(), versions(), (str(tmp_path / "gone"),), "token")
        assert answer(question, str(tmp_path / "nowhere")).token == ""


class TestAsked:
    def test_results_go_by_files_in_a_common_folder(self, address: str, tmp_path: Path) -> None:
        told = Told()
        with open_workers(address, 1, Question(versions, (), str(tmp_path)), told) as workers:
            assert workers.threads == 6
            assert workers.versions == [versions()]
            job = workers.prepared(picture, tmp_path / "parcels")
            done = {o.task: o.result for o in run_tiles(range(9), job, workers, 4)}
            assert all(isinstance(parcel, Parcel) for parcel in done.values())
            for task, parcel in done.items():
                np.testing.assert_array_equal(parcel.open(), picture(task))
        assert list((tmp_path / "parcels").iterdir()) == []
        assert [path.name for path in tmp_path.iterdir()] == ["parcels"]
        assert told.talked == []

    def test_without_one_they_go_to_the_client(self, address: str, tmp_path: Path) -> None:
        with open_workers(address, 1, Question(versions, (), str(tmp_path / "nowhere")), Told()) as workers:
            job = workers.prepared(picture, tmp_path / "parcels")
            done = {o.task: o.result for o in run_tiles(range(3), job, workers, 4)}
        np.testing.assert_array_equal(done[2], picture(2))
        assert not (tmp_path / "parcels").exists()

    def test_an_input_that_is_not_there_is_refused_before_any_tile(self, address: str, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="does not see"):
            open_workers(address, 1, Question(versions, (str(tmp_path / "gone.tif"),)), Told())

    def test_a_worker_that_comes_later_is_asked_with_every_tile(self) -> None:
        assert RemoteJob(len, source_fingerprint(), None)("abc") == 3
        with pytest.raises(UsageError, match="another photoplan"):
            RemoteJob(len, "another", None)("abc")

    def test_a_parcel_that_changed_on_its_way_is_refused(self, tmp_path: Path) -> None:
        parcel = RemoteJob(picture, source_fingerprint(), str(tmp_path))(7)
        Path(parcel.path).write_bytes(b"x" + Path(parcel.path).read_bytes()[1:])
        with pytest.raises(ResourceError, match="damaged"):
            parcel.open()


class TestFault28:
    @pytest.fixture(autouse=True)
    def hasty(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(clusters, "PATIENCE", 1.0)

    def test_fault_28_a_scheduler_without_workers(self) -> None:
        with (
            local(0) as cluster,
            pytest.raises(ResourceError, match="has no workers; start some with `dask worker tcp"),
        ):
            Cluster(cluster.scheduler_address, 2)

    @pytest.mark.parametrize("what", ["scheduler", "workers"])
    def test_fault_28_lost_in_the_middle(self, what: str) -> None:
        """Told, not waited for; exit code 5."""
        GO.clear()

        def lose(cluster: Any) -> None:
            if what == "scheduler":
                GO.set()
                cluster.close()
            else:
                cluster.scale(0)

        cluster = local(1)
        try:
            with (
                Workers(
                    executor_factory(cluster.scheduler_address, 1), 3, Cluster(cluster.scheduler_address, 2)
                ) as workers,
                pytest.raises(ResourceError, match="finished tiles are kept") as error,
            ):
                running = run_tiles(range(30), first_alone, workers, 4)
                assert next(running).task == 0
                losing = threading.Thread(target=lose, args=(cluster,))
                losing.start()
                list(running)
            assert error.value.exit_code == 5
        finally:
            GO.set()
            cluster.close()


def test_a_job_is_told_in_few_bytes(address: str) -> None:
    """What travels with a tile does not grow with its product."""
    import pickle

    assert len(pickle.dumps(RemoteJob(picture, source_fingerprint(), "/products/.one.parcels"))) < 400
