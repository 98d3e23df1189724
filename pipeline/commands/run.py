"""``stmnist train``, ``convert`` and ``ladder``: the stages of a run."""

from __future__ import annotations

import json
import sys

from deploy.files import write_json
from deploy.results import read_result
from deploy.targets import TARGETS
from pipeline import stages
from pipeline.commands import options
from pipeline.ladder import STAGES, ladder_json, ladder_text
from pipeline.run_folder import RunFolder


def train(
    run: options.Run,
    data: options.Data = None,
    seed: options.Seed = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
):
    """Train the paper's CNN on tactile images."""
    folder = RunFolder(run)
    with folder.locked():
        resolved = options.resolve(folder, data, seed, None, None, settings, set_)
        dataset = stages.open_dataset(folder, resolved, jobs, _say)
        stages.train(folder, resolved, dataset, _say)


def convert(
    run: options.Run,
    data: options.Data = None,
    seed: options.Seed = None,
    samples: options.Samples = None,
    steps: options.Steps = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
):
    """Train with rate-based LIF neurons, make them spike, write the bundle."""
    folder = RunFolder(run)
    with folder.locked():
        resolved = options.resolve(folder, data, seed, samples, steps, settings, set_)
        _bundle(folder, resolved, jobs)


def ladder(
    run: options.Run,
    data: options.Data = None,
    seed: options.Seed = None,
    samples: options.Samples = None,
    steps: options.Steps = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Do what is missing up to the emulator, and print what each stage loses."""
    folder = RunFolder(run)
    with folder.locked():
        resolved = options.resolve(folder, data, seed, samples, steps, settings, set_)
        bundle = _bundle(folder, resolved, jobs)
        results = []
        for stage in STAGES:
            if stage in ("nengo", "simreal", "emulator"):
                results.append(stages.check(folder, resolved, bundle, stage, _say))
            elif stage not in TARGETS or folder.check(stage).exists():
                path = folder.check(stage)
                # A board's result is a row of its own if it is there and of this bundle.
                if stage != "loihi" or (path.exists() and read_result(path)["bundle"] == bundle.id):
                    results.append(read_result(path))
        table = ladder_json(results)
        write_json(folder.ladder, table)
    print(json.dumps(table, indent=2) if as_json else "\n" + ladder_text(table))


def _bundle(folder, resolved, jobs):
    dataset = stages.open_dataset(folder, resolved, jobs, _say)
    stages.train(folder, resolved, dataset, _say)
    stages.train_rates(folder, resolved, dataset, _say)
    return stages.convert(folder, resolved, dataset, _say)


def _say(line):
    """What happens goes to standard error, answers to standard output."""
    print(line, file=sys.stderr)
