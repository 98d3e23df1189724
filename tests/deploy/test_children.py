"""Children end with their parent, however that ends."""

import os
import select
import signal
import sys
import textwrap

import pytest

from deploy import children
from tests.command import environment, process_of

WORKERS = """
    import sys
    from pipeline.jobs import run_jobs
    from tests.deploy.test_children import say_and_wait
    {before}
    list(run_jobs(say_and_wait, [0, 1], 2))
"""


def say_and_wait(job):
    """A job that names its process and then never ends by itself."""
    os.write(1, f"{os.getpid()}\n".encode())
    signal.pause()


def ended(processes, seconds=300):
    """Whether processes, as open file numbers of theirs, all end."""
    watch = select.poll()
    for number in processes:
        watch.register(number, select.POLLIN)
    left = set(processes)
    while left:
        found = watch.poll(1000 * seconds)
        if not found:
            return False
        for number, _ in found:
            watch.unregister(number)
            left.remove(number)
    return True


@pytest.mark.parametrize(
    ("how", "before"),
    [
        *((how, "") for how in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)),
        (signal.SIGKILL, "import stmnist"),
    ],
)
def test_workers_end_with_who_started_them(how, before):
    code = textwrap.dedent(WORKERS).format(before=before)
    if before:
        code = before + code
    with process_of("-c", code, stdout=-1, env=environment()) as parent:
        workers = [os.pidfd_open(int(parent.stdout.readline())) for _ in range(2)]
        try:
            parent.send_signal(how)
            assert ended(workers)
            # Its pipes are closed: nobody who reads them waits for the workers, nor for the
            # processes that joblib starts to tidy up.
            assert parent.communicate(timeout=300) is not None
        finally:
            for number in workers:
                os.close(number)


CHILD = """
    import os, subprocess, sys, time
    code = '''if True:
        import os, signal, sys
        from deploy import children
        {fallback}
        children.end_with_named_parent()
        os.write(1, f"{{os.getpid()}}\\\\n".encode())
        signal.pause()
    '''
    named = {{**os.environ, "STMNIST_PARENT": str(os.getpid())}}
    subprocess.Popen([sys.executable, "-c", code], env=named).wait()
"""


@pytest.mark.parametrize("fallback", ["", "del os.pidfd_open; children.LOOK_S = 0.01"])
def test_a_process_that_was_told_who_its_parent_is(fallback):
    code = textwrap.dedent(CHILD).format(fallback=fallback)
    with process_of("-c", code, stdout=-1, env=environment()) as parent:
        child = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        assert ended([child])
        os.close(child)


def test_a_parent_that_has_ended_already():
    code = "from deploy.children import end_with; end_with(1 << 22); print('went on')"
    with process_of("-c", code, stdout=-1, env=environment()) as process:
        out, _ = process.communicate(timeout=300)
    assert (process.returncode, out) == (-signal.SIGKILL, b"")


@pytest.mark.parametrize("named", ["", "x", "\u0661"])
def test_nobody_is_named(monkeypatch, named):
    monkeypatch.setenv(children.PARENT, named)
    monkeypatch.setattr(children, "end_with", lambda parent: sys.exit(1))
    children.end_with_named_parent()
    assert children.PARENT not in os.environ
