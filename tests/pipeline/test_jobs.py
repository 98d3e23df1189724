import os
import signal
import time
import warnings
from functools import partial
from threading import Thread

import pytest
from joblib import delayed

from deploy.errors import UserError
from pipeline import interrupts, jobs
from pipeline.jobs import Failure, run_jobs
from pipeline.simulation.simulate import simulate_recordings


def reciprocal(number):
    return 1 / number


@pytest.mark.parametrize("processes", [1, 2])
def test_a_failure_does_not_stop_the_others(processes):
    results = dict(run_jobs(reciprocal, [1, 2, 0, 4], processes))
    assert {job: results[job] for job in (1, 2, 4)} == {1: 1.0, 2: 0.5, 4: 0.25}
    assert isinstance(results[0], Failure)
    assert results[0].error == "ZeroDivisionError: division by zero"
    assert "reciprocal" in results[0].details


def die_of_two(number):
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def refuse(number):
    raise {0: UserError("snn.tau_rc: 0; " + "give more " * 30), 1: MemoryError(), 2: KeyError(7)}[
        number
    ]


def test_what_was_raised_in_a_process_can_be_raised_again():
    failures = dict(run_jobs(refuse, [0, 1, 2], 2))
    with pytest.raises(UserError, match=r"^target fast: snn.tau_rc: 0; (give more ){30}$"):
        failures[0].raise_again("target fast")
    with pytest.raises(MemoryError):
        failures[1].raise_again("target fast")
    with pytest.raises(RuntimeError, match=r"(?s)Traceback .*in refuse.*KeyError: 7"):
        failures[2].raise_again("target fast")


def test_a_killed_process_is_a_failure():
    results = dict(run_jobs(die_of_two, [0, 1, 2, 3, 4], 2))
    assert set(results) == {0, 1, 2, 3, 4}
    assert "killed" in results[2].error


def test_workers_never_receive_ctrl_c():
    masked = partial(signal.pthread_sigmask, signal.SIG_BLOCK, [])
    here = masked()
    for processes in (2, 1):  # with 1 the calls are made in this process
        with jobs.call_in_processes([delayed(masked)() for _ in range(4)], processes) as results:
            assert masked() == here  # this process does
            assert [signal.SIGINT in mask for mask in results] == [processes == 2] * 4
        assert masked() == here


def say_something(path):
    path.write_text("working")


def test_jobs_work_while_this_process_does_something_else(tmp_path):
    """The pipe is read here, which waits for the job that writes it."""
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    jobs = [pipe, tmp_path / "file"]
    done = dict(run_jobs(say_something, jobs, 2, meanwhile=lambda: read.append(pipe.read_text())))
    assert read == ["working"]
    assert done == dict.fromkeys(jobs)


def slow(number):
    time.sleep(600)  # ended by who asked for it


@pytest.mark.parametrize("gives_up", [KeyboardInterrupt, UserError])
def test_what_goes_on_meanwhile_may_fail_or_be_interrupted(gives_up):
    """The processes end, and nothing is said of them."""

    def meanwhile():
        raise gives_up("enough")

    with warnings.catch_warnings(record=True) as told, pytest.raises(gives_up):
        list(run_jobs(slow, [0, 1, 2], 2, meanwhile=meanwhile))
    assert told == []


def complain_at_length(job):
    raise ValueError("word " * 500)


def test_a_long_message_is_cut_and_kept_in_the_details():
    ((_, failure),) = run_jobs(complain_at_length, [1])
    assert len(failure.error) < 200
    assert failure.error.endswith("…")
    assert "word " * 500 in failure.details


def test_no_jobs():
    assert list(run_jobs(reciprocal, [], 2)) == []


def test_an_interruption_that_native_code_converts_is_no_failure(monkeypatch):
    monkeypatch.setattr(interrupts, "_seen", [2])
    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(int, ["no number", "1"], 1))


def test_an_interruption_is_no_failure():
    def interrupt(job):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(interrupt, [1]))


def test_a_wrong_address_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(jobs, "CONNECT_TIMEOUT_S", 0.1)
    with pytest.raises(UserError, match=r"tcp://127\.0\.0\.1:1"):
        list(run_jobs(reciprocal, [1], scheduler="tcp://127.0.0.1:1"))


def test_on_a_dask_cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        results = dict(run_jobs(reciprocal, [2, 0], scheduler=cluster.scheduler_address))
    assert results[2] == 0.5
    assert results[0].error.startswith("ZeroDivisionError")


@pytest.fixture
def cluster(request):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        **request.param, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster


@pytest.mark.parametrize("cluster", [{"n_workers": 0, "processes": False}], indirect=True)
def test_jobs_wait_for_a_worker(cluster):
    said = []

    def say(line):
        said.append(line)
        cluster.scale(1)

    assert list(run_jobs(reciprocal, [2], 1, cluster.scheduler_address, say)) == [(2, 0.5)]
    assert len(said) == 1
    assert cluster.scheduler_address in said[0]


def record_some(seed):
    """Simulate ten recordings; the process, and the hashes of the recordings."""
    return os.getpid(), simulate_recordings(seed, [1] * 10, jobs=1).hashes


def die(job):
    os._exit(1)


@pytest.mark.parametrize("cluster", [{"n_workers": 2, "processes": True}], indirect=True)
def test_two_workers_make_the_recordings_that_one_process_makes(cluster):
    """And a job that kills them is a failure."""
    seeds = [0, 1, 2, 3]
    results = dict(run_jobs(record_some, seeds, scheduler=cluster.scheduler_address))
    processes = {process for process, _ in results.values()}
    assert len(processes) == 2
    assert os.getpid() not in processes
    assert results[1][1] == record_some(1)[1]
    assert len({hashes for _, hashes in results.values()}) == len(seeds)

    cluster.scheduler.allowed_failures = 0
    ((job, failure),) = run_jobs(die, [1], scheduler=cluster.scheduler_address)
    assert job == 1
    assert failure.error.startswith("KilledWorker: ")
    assert len(failure.error) < 200


@pytest.mark.parametrize("cluster", [{"n_workers": 0, "processes": False}], indirect=True)
def test_a_scheduler_that_goes_away_is_a_failure(cluster):
    address = cluster.scheduler_address
    gone = Thread(target=cluster.close)
    ((job, failure),) = run_jobs(reciprocal, [2], 1, address, lambda line: gone.start())
    gone.join()
    assert job == 2
    assert address in failure.error
