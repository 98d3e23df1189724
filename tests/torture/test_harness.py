"""The campaign itself: the same case from the same seed, and findings that are found."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.command import printed_by, process_of
from tests.deploy.networks import bundle_at
from tests.torture import bounded, breaks, damage, inputs


@pytest.fixture
def base(tmp_path):
    """As much of a finished run as most kinds need."""
    run = tmp_path / "base" / "run"
    bundle_at(run / "bundle")
    (run / "experiment.toml").write_text("seed = 0\n\n[cnn]\nepochs = 3\n")
    (run / "checks").mkdir()
    for name in ("emulator", "nengo"):
        (run / "checks" / f"{name}.json").write_text(json.dumps({"samples": [{"id": "a"}]}))
    run.with_name("st.zip").write_bytes(b"PK")
    return inputs.Base(run)


def contents(folder):
    """The bytes of each file, or its size if it is a sparse one of a terabyte."""
    files = [p for p in folder.rglob("*") if p.is_file()]
    return {
        p.relative_to(folder): size if (size := p.stat().st_size) >> 30 else p.read_bytes()
        for p in files
    }


@pytest.mark.parametrize("kind", sorted(set(inputs.KINDS) - {"run", "cache", "mat73", "source"}))
def test_a_case_is_the_same_again(kind, base, tmp_path):
    """SciPy and zip write the time of day into their files: for these the draws are compared."""
    for case in range(4):
        made = []
        for name in ("a", "b"):
            folder = tmp_path / f"{name}{case}"
            folder.mkdir()
            rng = np.random.default_rng([1, 0, case])
            inputs.make(kind, rng, folder, base)
            found = contents(folder)
            timed = kind in ("mat5", "zip", "bundle", "person")
            made.append((found.keys() if timed else found, rng.bit_generator.state))
        assert made[0] == made[1]


def test_a_campaign_has_of_every_kind():
    kinds = inputs.plan(200)
    assert len(kinds) == 200
    least = {kind: 1 if kind == "source" else 5 for kind in inputs.SHARES}
    assert {kind: kinds.count(kind) >= n for kind, n in least.items()} == dict.fromkeys(least, True)
    assert sum(inputs.SHARES.values()) == pytest.approx(1)


def test_damaged_bytes_are_other_bytes():
    rng = np.random.default_rng(0)
    content = bytes(range(200))
    assert sum(damage.some_bytes(rng, content) != content for _ in range(100)) > 95


def outcome(status=0, err="", seconds=1.0, memory=10**8):
    return bounded.Outcome(status, "", err, seconds, memory)


@pytest.mark.parametrize(
    ("ended", "found"),
    [
        (outcome(), None),
        (outcome(2, "stmnist: a.mat: is damaged; try another\n"), None),
        (outcome(2, "left out 3/a.mat\nstmnist: st.zip: no recording\n"), None),
        (outcome(2, "usage: me\n"), "0 lines"),
        (outcome(2, "stmnist: a.zip: b\nusage: me\n"), "1 lines"),
        (outcome(2, "stmnist: a.zip: x\nstmnist: a.zip: y\n"), None),
        (outcome(2, "stmnist: a: x\nstmnist: b: x\n"), "more than one source"),
        (outcome(2, "stmnist: a: x\n" * 99), "99 lines"),
        (outcome(2, "stmnist: " + "x" * 9000), "a line of 9009 characters"),
        (outcome(1, "Traceback (most recent call last):\nValueError: x\n"), "a traceback"),
        (outcome(0, "Traceback (most recent call last):\nValueError: x\n"), "a traceback"),
        (outcome(-11), "died of signal 11"),
        (outcome(seconds=30), "took 30 s"),
        (replace(outcome(), blocked=True), "had not ended"),
        (outcome(memory=3 << 30), "took 3072 MB"),
    ],
)
def test_what_is_a_finding(ended, found):
    assert (ended.finding is None) if found is None else (found in ended.finding)


IN_ANOTHER = """
import json, sys
from dataclasses import asdict
from pathlib import Path
from tests.torture import bounded

folder = Path(sys.argv[1])
for streams in json.loads(sys.argv[2]):
    streams = {int(number): how for number, how in streams.items()}
    ended = bounded.run(["data", "inspect", folder / "a.mat"], folder, 300, streams)
    print(json.dumps(asdict(ended)))
"""


def outcomes(folder, *streams):
    """The outcomes of a command on a damaged recording, for each state of its standard streams.

    It is called in a fork, as in a campaign, but not of this process, in which other tests have
    filled the memory and started threads.
    """
    (folder / "a.mat").write_bytes(b"hello")
    lines = printed_by(IN_ANOTHER, folder, json.dumps(streams)).splitlines()
    return [bounded.Outcome(**json.loads(line)) for line in lines]


def test_a_command_is_called_within_limits(tmp_path):
    (ended,) = outcomes(tmp_path, {})
    # How long it takes is the machine's matter.
    assert (ended.status, replace(ended, seconds=0).finding) == (2, None)
    assert "a.mat: " in ended.err
    assert ended.memory > 10**7


def test_what_differs_from_an_uninterrupted_run_is_named(tmp_path):
    (tmp_path / "a.json").write_text('{"accuracy": 0.5, "seconds": 3.1}')
    (tmp_path / "b.bin").write_bytes(b"b")
    whole = breaks.Whole(1.0, {**breaks.fingerprint(tmp_path), "c.bin": "0"})
    (tmp_path / "a.json").write_text('{"accuracy": 0.5, "seconds": 9.9}')
    (tmp_path / "b.bin").write_bytes(b"other")
    (tmp_path / "tmp").mkdir()
    (tmp_path / "tmp" / "left").write_text("")
    assert list(breaks.compared(tmp_path, whole)) == [
        "b.bin is not the same",
        "c.bin is missing",
        "tmp/left is left over",
    ]


def test_a_report_of_another_minute_is_the_same(tmp_path):
    prints = []
    for minute, accuracy in (("03:16", 0.9), ("03:17", 0.9), ("03:17", 0.8)):
        (tmp_path / "report.html").write_text(f"report of 2026-11-22 {minute} UTC: {accuracy}")
        prints.append(breaks.fingerprint(tmp_path))
    assert prints[0] == prints[1] != prints[2]


def test_what_was_written_through_a_link_is_found(base, tmp_path):
    inputs.links(np.random.default_rng(0), tmp_path, base)
    assert inputs.harmed(tmp_path) is None
    (tmp_path / "elsewhere" / "precious").write_bytes(b"")
    assert "wrote through a link" in inputs.harmed(tmp_path)
    assert inputs.harmed(tmp_path / "run") is None


@pytest.mark.parametrize(
    ("streams", "ended", "found"),
    [
        ({1: "closed"}, outcome(1), None),
        ({1: "closed"}, outcome(0), "status 0, not 1"),
        ({1: "full"}, outcome(2), None),
        ({2: "full"}, outcome(2), "status 2, not 1"),
        ({2: "closed"}, outcome(1, "Traceback (most recent call last):\nOSError"), "a traceback"),
    ],
)
def test_what_a_closed_or_full_stream_must_not_change(streams, ended, found):
    changed = bounded.changed_by(streams, outcome(1), ended)
    assert (changed is None) if found is None else (found in changed)


def test_streams_of_a_command_are_closed_and_full(tmp_path):
    cases = ({1: "closed"}, {2: "closed"}, {1: "full"}, {2: "full"})
    for streams, ended in zip(cases, outcomes(tmp_path, *cases), strict=True):
        assert ended.status == 2
        assert ("a.mat: " in ended.err) == (2 not in streams)


def test_what_outlives_a_command_is_named():
    with process_of("-c", "import time; time.sleep(600)", stdout=-1) as process:
        (line,) = breaks._of_session(process.pid)
        assert f"{process.pid} " in line
    assert breaks._of_session(process.pid) == []


def test_the_order_of_keys_counts(tmp_path):
    prints = []
    for text in ('{"a": 1, "b": 2}', '{"b": 2, "a": 1}'):
        (tmp_path / "a.json").write_text(text)
        prints.append(breaks.fingerprint(tmp_path))
    assert prints[0] != prints[1]
