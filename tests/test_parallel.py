"""One function over many items: here, in processes or on a cluster, with the same outcome."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import working

from tonguetrack import InputError, parallel
from tonguetrack.parallel import Failed, cluster, executor, local

POSIX = pytest.mark.skipif(os.name != "posix", reason="signals between processes are POSIX's")


@pytest.fixture(scope="module")
def scheduler():
    """The address of a Dask cluster with two worker processes of two threads."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None, silence_logs=60
    ) as made:
        yield made.scheduler_address


@pytest.fixture(scope="module", params=["in this process", "in 2 processes", "on a cluster"])
def workers(request):
    if request.param == "on a cluster":
        with cluster(request.getfixturevalue("scheduler")) as made:
            yield made
    else:
        with local(1 if request.param == "in this process" else 2) as made:
            assert made.where == request.param
            yield made


# The outcome ----------------------------------------------------------------------------------------


def test_results_come_in_the_order_of_the_items_however_long_each_takes(workers):
    assert list(workers.run(working.slow_at_first, range(12))) == list(range(12))


def test_an_item_that_cannot_be_used_becomes_its_sentence_and_the_rest_goes_on(workers):
    outcomes = list(workers.run(working.squared, [5, 6, 7, 8]))
    assert outcomes == [25, 36, Failed("7: nobody squares sevens."), 64]


def test_any_other_error_passes_through_and_names_the_item(workers):
    with pytest.raises(KeyError, match="no 41") as caught:
        list(workers.run(working.with_a_bug, [41]))
    assert caught.value.__notes__ == ["This happened while working on 41."]
    assert list(workers.run(working.squared, [3])) == [9]


def test_progress_is_told_from_nothing_to_everything_and_never_goes_back(workers):
    seen = []
    list(workers.run(working.slow_at_first, range(9), lambda finished, total: seen.append((finished, total))))
    assert seen[0] == (0, 9)
    assert seen[-1] == (9, 9)
    assert seen == sorted(seen)


def test_nothing_to_do_is_done_at_once(workers):
    assert list(workers.run(working.squared, [])) == []


def test_only_so_many_items_are_begun_ahead_of_the_results_that_are_taken(workers, tmp_path):
    outcomes = workers.run(partial(working.told, tmp_path), range(200))
    assert next(outcomes) == 0
    time.sleep(0.3)
    assert 1 <= len(list(tmp_path.iterdir())) <= 2 * parallel.AT_HAND
    assert list(outcomes) == list(range(1, 200))


# Processes ------------------------------------------------------------------------------------------


def test_every_local_worker_has_one_thread():
    with local(2) as made:
        found = list(made.run(working.threads, range(2)))
    for environment in found:
        assert environment["NUMBA_NUM_THREADS"] == environment["OPENBLAS_NUM_THREADS"] == "1"


@POSIX
def test_a_local_worker_that_is_killed_is_one_sentence():
    with pytest.raises(InputError, match="ended from outside.*fewer jobs"), local(2) as made:
        list(made.run(working.dying, range(4)))


@POSIX
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_the_workers_end_with_the_process_that_started_them(name, tmp_path):
    """Ctrl-C reaches all processes of a terminal; the other two reach the first process only."""
    how = getattr(signal, name)
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import working\nfrom functools import partial\nfrom tonguetrack.parallel import local\n"
        "if __name__ == '__main__':\n"
        f"    with local(2) as made: list(made.run(partial(working.sleeping, {str(tmp_path)!r}), range(9)))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script], start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    if how == signal.SIGINT:
        os.killpg(process.pid, how)
    else:
        process.send_signal(how)
    _, told = process.communicate(timeout=20)
    assert process.returncode == -how
    wait_until(lambda: not any(is_running(int(file.name)) for file in tmp_path.iterdir()))
    if how == signal.SIGINT:
        assert told.count("Traceback") == 1  # nobody but the process itself complains


def wait_until(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    # One that ended but was not yet asked for its exit code still has its number.
    status = Path(f"/proc/{process}/stat")
    return not status.exists() or status.read_text().rpartition(")")[2].split()[0] != "Z"


# Clusters -------------------------------------------------------------------------------------------


def test_a_cluster_says_how_many_workers_it_has_and_that_their_spare_threads_rest(scheduler):
    with cluster(scheduler) as made:
        assert made.where.startswith(f"on 2 workers of the cluster {scheduler} (")
        assert "--nthreads 1" in made.where


@POSIX
def test_an_item_that_kills_every_worker_is_one_sentence(scheduler):
    with pytest.raises(InputError, match="several workers in a row ended"), cluster(scheduler) as made:
        list(made.run(working.dying, [2]))


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "127.0.0.1:8786", "tcp:/x", "tcp://localhost:99999999", ""]
)
def test_an_address_where_no_scheduler_answers_is_one_sentence(address):
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler answers here"), cluster(address):
        pass


def test_a_scheduler_that_goes_away_is_one_sentence(tmp_path):
    pytest.importorskip("distributed")
    program = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    process = subprocess.Popen(
        [*program, "--no-dashboard", "--scheduler-file", str(tmp_path / "address")],
        stderr=subprocess.DEVNULL,
        cwd=tmp_path,
    )
    try:
        wait_until(
            lambda: (tmp_path / "address").exists() and (tmp_path / "address").read_text().endswith("}")
        )
        address = json.loads((tmp_path / "address").read_text())["address"]

        def end_it(finished, total):
            process.kill()

        with (
            pytest.raises(InputError, match="the connection to the scheduler was lost"),
            cluster(address) as made,
        ):
            assert "no worker yet" in made.where
            list(made.run(working.squared, range(3), end_it))
    finally:
        process.kill()
        process.wait()


def test_a_worker_of_another_version_is_refused(scheduler, monkeypatch):
    monkeypatch.setattr(parallel, "__version__", "0.0.7")
    with (
        pytest.raises(InputError, match=r"a worker has tonguetrack .*, this is 0\.0\.7"),
        cluster(scheduler) as made,
    ):
        list(made.run(working.squared, range(3)))


def test_without_the_extra_its_name_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(InputError, match=r"pip install 'tonguetrack\[cluster\]'"),
        cluster("tcp://127.0.0.1:8786"),
    ):
        pass


# What is asked for ----------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [0, -1])
def test_no_jobs_cannot_do_anything(jobs):
    with pytest.raises(InputError, match="expected 1 or more"), local(jobs):
        pass


def test_jobs_and_a_scheduler_exclude_each_other():
    with pytest.raises(InputError, match="give one of the two"):
        executor(2, "tcp://127.0.0.1:8786")
