import pytest

from deploy.errors import UserError
from pipeline.parallel import Failure, run_jobs


def reciprocal(number):
    return 1 / number


@pytest.mark.parametrize("processes", [1, 2])
def test_a_failure_does_not_stop_the_others(processes):
    results = dict(run_jobs(reciprocal, [1, 2, 0, 4], processes))
    assert {job: results[job] for job in (1, 2, 4)} == {1: 1.0, 2: 0.5, 4: 0.25}
    assert isinstance(results[0], Failure)
    assert results[0].error == "ZeroDivisionError: division by zero"
    assert "reciprocal" in results[0].details


def complain_at_length(job):
    raise ValueError("word " * 500)


def test_a_long_message_is_cut_and_kept_in_the_details():
    ((_, failure),) = run_jobs(complain_at_length, [1])
    assert len(failure.error) < 200
    assert failure.error.endswith("…")
    assert "word " * 500 in failure.details


def test_no_jobs():
    assert list(run_jobs(reciprocal, [], 2)) == []


def test_an_interruption_is_no_failure():
    def interrupt(job):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(run_jobs(interrupt, [1]))


def test_a_wrong_address_is_named():
    pytest.importorskip("distributed")
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
