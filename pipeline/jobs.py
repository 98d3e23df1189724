"""Independent jobs: in processes of this machine, or on an existing Dask cluster."""

import logging
import signal
import sys
import traceback
import warnings
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from multiprocessing.resource_tracker import ensure_running

from joblib import Parallel, delayed
from joblib.externals.loky.process_executor import TerminatedWorkerError

from deploy.errors import KILLED_MESSAGE, UserError
from deploy.plugins import load_plugins
from pipeline.interrupts import raise_at_interrupts

# Largest number of characters in a failure's line; the traceback has the whole message.
MESSAGE_LENGTH = 160

# Seconds in which a scheduler must answer.
CONNECT_TIMEOUT_S = 5


@dataclass(frozen=True)
class Failure:
    """The error of a job that failed.

    Attributes
    ----------
    error : str
        One short line: the exception's type and message.
    details : str
        The traceback if there is one; for a user's mistake the whole message.
    mistake : UserError, optional
        The error itself, if it is a mistake of the user.
    """

    error: str
    details: str
    mistake: UserError | None = None

    def raise_again(self, task: str):
        """Raise the original error, or one with the same information.

        Parameters
        ----------
        task : str
            What failed, at the start of the message for the user.

        Raises
        ------
        UserError
            The user's mistake, or a process that was killed.
        MemoryError
        RuntimeError
            Any other error, with its traceback.
        """
        if self.mistake is not None:
            raise UserError(f"{task}: {self.mistake}")
        if self.error.startswith(MemoryError.__name__):
            raise MemoryError
        raise RuntimeError(self.details)


def run_jobs(
    function,
    jobs,
    processes: int = 1,
    scheduler: str | None = None,
    say=print,
    meanwhile=lambda: None,
):
    """Call a function once for each job, and yield each result when it is available.

    A job that fails does not stop the others.

    Parameters
    ----------
    function : callable
        Function of a module (workers import it), called as ``function(job)``.
    jobs : sequence
        Values that can be pickled.
    processes : int
        Number of processes of this machine; with 1 the jobs run in this process, in order.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://host:8786``; its workers run the jobs.
    say : callable
        Called with a message if the jobs have to wait.
    meanwhile : callable
        Called once in this process; if the jobs run in other processes, while they run.

    Yields
    ------
    job, result
        In the order of completion; the result is a :class:`Failure` if the function raised an
        error.

    Raises
    ------
    UserError
        There is no scheduler at the address, or Dask is not installed.
    """
    jobs = list(jobs)
    if scheduler is not None:
        meanwhile()
        yield from _run_on_cluster(function, jobs, scheduler, say)
    elif processes == 1 or len(jobs) <= 1:
        meanwhile()
        for job in jobs:
            yield job, attempt(function, job)
    else:
        yield from _run_in_processes(function, jobs, processes, meanwhile)


@contextmanager
def call_in_processes(calls, processes: int, in_order: bool = True):
    """Make calls in processes of this machine, from now on and until the block ends.

    A terminal sends Ctrl-C to all processes.  The workers inherit from this one that they do not
    receive it, also while they start: this process ends them.

    Parameters
    ----------
    calls : iterable
        Calls made with :func:`joblib.delayed`.
    processes : int
        With 1 the calls are made in this process.
    in_order : bool
        True for results in the order of the calls, False for the order of their ends.

    Yields
    ------
    iterator
        Each result when it is available.
    """
    order = "generator" if in_order else "generator_unordered"
    options = _list_worker_options() if processes != 1 else {}
    with warnings.catch_warnings(), ExitStack() as stack:
        # Workers whose memory has grown are replaced between jobs, and jobs are cancelled if the
        # caller stops.
        for expected in ("A worker stopped while some jobs", r"\d+ tasks (which were|have been)"):
            warnings.filterwarnings("ignore", message=expected)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
        stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        if processes != 1:
            ensure_running()  # otherwise it starts between the workers, and allows Ctrl-C again
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        with closing(Parallel(processes, return_as=order, **options)(calls)) as results:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            yield results


def _list_worker_options() -> dict:
    """Load the plugins and bind the packages of ``stmnist``, at the start of a joblib worker."""
    if "stmnist" in sys.modules:
        return {"initializer": sys.modules["stmnist"].prepare_worker}
    return {"initializer": load_plugins, "initargs": (True,)}


def _run_in_processes(function, jobs, processes, meanwhile):
    remaining = dict(enumerate(jobs))
    calls = (
        delayed(_run_numbered)(number, function, job) for number, job in remaining.copy().items()
    )
    try:
        with call_in_processes(calls, min(processes, len(jobs)), in_order=False) as results:
            meanwhile()
            for number, result in results:
                yield remaining.pop(number), result
    except TerminatedWorkerError:
        for job in remaining.values():
            yield job, Failure(KILLED_MESSAGE, KILLED_MESSAGE, UserError(KILLED_MESSAGE))


def _run_numbered(number, function, job):
    return number, attempt(function, job)


def _attempt_on_cluster(function, job):
    load_plugins(is_worker=True)
    return attempt(function, job)


def attempt(function, job):
    """Call a function for a job; return its result, or a :class:`Failure` if it raises an error."""
    try:
        with raise_at_interrupts():
            return function(job)
    except UserError as error:
        return Failure(_shorten(error), str(error), error)
    except Exception as error:
        return Failure(_shorten(error), traceback.format_exc())


def _shorten(error):
    message = " ".join(str(error).split()) or "no message"
    if len(message) > MESSAGE_LENGTH:  # TensorFlow's messages contain a traceback
        message = message[: MESSAGE_LENGTH - 1] + "…"
    return f"{type(error).__name__}: {message}"


def _run_on_cluster(function, jobs, scheduler, say):
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise UserError(
            "--scheduler needs Dask, which is not installed; pip install 'stmnist-loihi[cluster]'"
        ) from None
    try:
        client = Client(scheduler, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TimeoutError) as error:
        raise UserError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({type(error).__name__}); "
            "start one with 'dask scheduler' and give the address that it prints"
        ) from error
    # It logs tracebacks of a lost connection, which is reported below.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    with client:
        if not client.scheduler_info()["workers"]:
            say(f"{scheduler} has no workers yet; the jobs wait for one")
        tasks = {client.submit(_attempt_on_cluster, function, job, pure=False): job for job in jobs}
        for task in as_completed(tasks):
            if task.status == "finished":
                yield tasks[task], task.result()
            elif task.status == "cancelled":
                message = f"lost the scheduler {scheduler}"
                yield tasks[task], Failure(message, message)
            else:  # it has killed several workers, or they do not have this package
                error = task.exception()
                yield tasks[task], Failure(_shorten(error), f"{type(error).__name__}: {error}")
