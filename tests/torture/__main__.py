"""``python -m tests.torture``: run a campaign, or replay one of its cases.

Status 0: nothing found; 1: findings, each with the options that replay it.
"""

import argparse
import concurrent.futures
import json
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np

from . import bounded, breaks, connections, inputs

PARTS = ("inputs", "kills", "interruptions", "disks", "orphans", "connections")


def main():
    options = _parsed()
    folder = Path(options.folder or tempfile.mkdtemp(prefix="torture-")).absolute()
    print(f"seed {options.seed}, in {folder}", flush=True)
    base = made_base(folder / "base")
    found, counts = [], Counter()
    for part in PARTS:
        count = getattr(options, part)
        if count and options.part in (None, part):
            run = {"inputs": run_inputs, "connections": run_connections}.get(part, run_breaks)
            findings = run(part, count, options, folder / part, base, counts)
            found += findings
    for part, kinds in sorted(_by_part(counts).items()):
        text = ", ".join(f"{kind} {n}" for kind, n in sorted(kinds.items()))
        print(f"{part}: {sum(kinds.values())} ({text})")
    print(f"{len(found)} findings with seed {options.seed}")
    if options.folder is None and not found:
        shutil.rmtree(folder)
    sys.exit(1 if found else 0)


def _parsed():
    parser = argparse.ArgumentParser(prog="python -m tests.torture", description=__doc__)
    parser.add_argument("--seed", type=int, default=int(time.time()), help="default: the time")
    parser.add_argument("--inputs", type=int, default=1600, help="damaged inputs")
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--interruptions", type=int, default=60)
    parser.add_argument("--disks", type=int, default=12, help="full, read-only, two at once")
    parser.add_argument("--orphans", type=int, default=180, help="signals to a command alone")
    parser.add_argument("--connections", type=int, default=20, help="attacks on the live page")
    parser.add_argument("--part", choices=PARTS, help="only this")
    parser.add_argument("--case", type=int, help="only this case of the part; its files are kept")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--folder", help="where to work (default: a temporary folder)")
    return parser.parse_args()


def made_base(folder):
    """Finished tiny runs on images and on events, their cache and a zip of recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "done").exists():
        for name, arguments in (
            ("run", ["ladder", folder / "run", *breaks.TINY]),
            ("events", ["ladder", folder / "events", *breaks.TINY_EVENTS]),
            ("st.zip", ["data", "simulate", "--out", folder / "st.zip",
                        "--samples-per-digit", 60]),
        ):  # fmt: skip
            print(f"made first: {name}", flush=True)
            (folder / "tmp").mkdir(exist_ok=True)
            command = breaks.Command(name, lambda f, given=arguments: given)
            if breaks.finish(breaks.start(command, folder)) != 0:
                sys.exit(f"torture: {name} could not be made: {breaks.said(folder)[-500:]}")
        (folder / "done").touch()
    return folder


def generator(options, part, case):
    """The case's own, whatever the others do."""
    return np.random.default_rng([options.seed, PARTS.index(part), case])


def run_inputs(part, count, options, folder, base, counts):
    """Cases in forks of processes that have imported everything, one a job."""
    kinds = inputs.plan(count)
    cases = [options.case] if options.case is not None else range(count)
    jobs = 1 if options.case is not None else options.jobs
    folder.mkdir(parents=True, exist_ok=True)
    logs, children = [folder / f"{job}.jsonl" for job in range(jobs)], []
    sys.stdout.flush()
    for job, log in enumerate(logs):
        child = os.fork()
        if child == 0:
            status = 1
            try:
                _shard(list(cases)[job::jobs], kinds, options, folder / str(job), base, log)
                status = 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                os._exit(status)
        children.append(child)
    if any([os.waitpid(child, 0)[1] for child in children]):
        sys.exit("torture: the harness itself failed")
    found, slowest, largest = [], (0, None), (0, None)
    for record in (json.loads(line) for log in logs for line in log.read_text().splitlines()):
        kind = record["kind"]
        counts[part, kind] += 1
        slowest = max(slowest, (record["seconds"], f"{kind} {record['case']}"))
        largest = max(largest, (record["memory"] >> 20, f"{kind} {record['case']}"))
        counts[f"{part}: ended with", f"status {record['status']}"] += 1
        if record["finding"]:
            found.append(record)
    print(f"slowest: {slowest[0]:.1f} s ({slowest[1]}); largest: {largest[0]} MB ({largest[1]})")
    return found


def _shard(cases, kinds, options, folder, base, log):
    _warm(base, folder)
    given = [inputs.Base(base / name) for name in ("run", "events")]
    with log.open("w") as file:
        for case in cases:
            place = folder / str(case)
            place.mkdir(parents=True)
            rng = generator(options, "inputs", case)
            which = given[int(rng.integers(0, len(given)))]
            arguments = inputs.make(kinds[case], rng, place, which)
            outcome = bounded.run(arguments, place)
            finding = outcome.finding or inputs.harmed(place)
            if finding is None and (
                streams := bounded.streams_of(
                    np.random.default_rng([options.seed, len(PARTS), case])
                )
            ):
                again = bounded.run(arguments, place, streams=streams)
                finding = bounded.changed_by(streams, outcome, again)
            record = {
                "case": case, "kind": kinds[case], "finding": finding,
                "seconds": outcome.seconds, "memory": outcome.memory, "status": outcome.status,
            }  # fmt: skip
            print(json.dumps(record), file=file, flush=True)
            if finding:
                _say(options, "inputs", case, kinds[case], [finding])
            if options.case is not None:
                print(f"status {outcome.status}\n{outcome.out}{outcome.err}kept in {place}")
            else:
                shutil.rmtree(place)


def _warm(base, folder):
    """Import what the commands import, and let Numba compile, so that a case takes no seconds."""
    import scipy.io  # noqa: F401

    from deploy.check.bundle import read_bundle
    from deploy.targets.registry import answer
    from pipeline.commands.main import with_every_verb
    from pipeline.results.report.gather import gather  # noqa: F401

    with_every_verb()
    for name in ("run", "events"):
        opened = read_bundle(base / name / "bundle")
        answer(opened.spec, opened.checks.inputs[:1], "fast")


def run_breaks(part, count, options, folder, base, counts):
    """Cases in processes of their own, some at a time."""
    named = {command.name: command for command in breaks.COMMANDS}
    names = [n for command in breaks.COMMANDS for n in [command.name] * weight(command.name)]
    whole, found = {}, []
    folder.mkdir(parents=True, exist_ok=True)

    def case_of(number):
        rng = generator(options, part, number)
        name = names[int(rng.integers(0, len(names)))] if part != "disks" else None
        if part == "disks":
            name = list(named)[number // 3 % len(named)]
        return rng, named[name]

    def expected(command):
        if command.name not in whole:
            whole[command.name] = breaks.whole(command, folder / f"whole-{command.name}", base)
        return whole[command.name]

    def one(number):
        rng, command = case_of(number)
        place = folder / str(number)
        if part == "disks":
            kind = ("full", "read-only", "two")[number % 3]
            if kind == "full":
                findings = breaks.full_disk(command, rng, place, base, whole[command.name])
            elif kind == "read-only":
                findings = breaks.read_only(command, rng, place, base)
            else:
                findings = breaks.two_at_once(command, rng, place, base, whole[command.name])
            stops, kind = 1, f"{kind} {command.name}"
        elif part == "orphans":
            how = breaks.SIGNALS[number % len(breaks.SIGNALS)]
            findings = breaks.orphaned(command, rng, place, base, how)
            stops, kind = 1, f"{how.name} {command.name}"
        else:
            how = {"kills": "kill", "interruptions": "interrupt"}[part]
            stops, findings = breaks.broken(
                command, rng, place, base, whole[command.name], how, int(rng.integers(1, 6))
            )
            kind = command.name
        if options.case is None:
            shutil.rmtree(place, ignore_errors=True)
        return number, kind, stops, findings

    done, number = 0, options.case or 0
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        waiting = set()
        while waiting or done < count:
            while len(waiting) < options.jobs and done + 2 * len(waiting) < count:
                if part != "orphans":
                    expected(case_of(number)[1])
                waiting.add(pool.submit(one, number))
                number += 1
                if options.case is not None:
                    done = count
            ended, waiting = concurrent.futures.wait(
                waiting, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for task in ended:
                case, kind, stops, findings = task.result()
                counts[part, kind] += stops
                done += stops if part != "disks" else 1
                if findings and not findings[0].endswith("left out"):
                    found.append(findings)
                    _say(options, part, case, kind, findings)
    return found


def run_connections(part, count, options, folder, base, counts):
    """Attacks on the live page, one after the other: each has the machine to itself."""
    found = []
    for case in [options.case] if options.case is not None else range(count):
        place = folder / str(case)
        findings = connections.attacked(generator(options, part, case), place, base)
        counts[part, "attacks"] += 1
        if findings:
            found.append(findings)
            _say(options, part, case, "connections", findings)
        if options.case is None:
            shutil.rmtree(place, ignore_errors=True)
    return found


def weight(name):
    """How often a command is chosen among the others."""
    return breaks.WEIGHTS.get(name, 1)


def _say(options, part, case, kind, findings):
    replay = f"--seed {options.seed} --part {part} --case {case}"
    if part == "inputs":
        replay += f" --inputs {options.inputs}"
    print(f"FOUND {kind} ({replay}):", *findings, sep="\n  ", flush=True)


def _by_part(counts):
    parts = {}
    for (part, kind), n in counts.items():
        parts.setdefault(part, {})[kind] = n
    return parts


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    main()
