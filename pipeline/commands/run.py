"""``stmnist train``, ``convert`` and ``ladder``: the stages of a run."""

from __future__ import annotations

import json
import sys
from typing import Annotated, Optional

import typer

from deploy.check.results import read_result
from deploy.files import read_json, replacing, write_json
from pipeline.commands import options
from pipeline.progress import progress
from pipeline.run import stages
from pipeline.run.answers import STAGES as REFERENCES
from pipeline.run.answers import rate_activations
from pipeline.run.diagnosis import layers_json
from pipeline.run.folder import RunFolder
from pipeline.run.ladder import SLOW, STAGES, WHOLE_STAGES, ladder_json, ladder_text


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
        _, bundle = make_bundle(folder, resolved, jobs)
        for stage in REFERENCES:
            stages.answer(folder, resolved, bundle, stage, _say)


def ladder(
    run: options.Run,
    data: options.Data = None,
    seed: options.Seed = None,
    samples: options.Samples = None,
    steps: options.Steps = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    whole: Annotated[
        bool, typer.Option("--whole", help="On the whole test split, not on the check's samples.")
    ] = False,
    slow: Annotated[
        bool,
        typer.Option("--slow", help="With --whole: NengoCore and simreal too, minutes each."),
    ] = False,
    limit: Annotated[
        Optional[float],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(
            help="Points a stage may lose before its layers are shown (default: 1 with --whole, "
            "else 3, since chance alone moves 200 samples by 2.5)."
        ),
    ] = None,
    as_json: options.Json = False,
):
    """Do what is missing up to the emulator, and print what each stage loses."""
    folder = RunFolder(run)
    with folder.locked():
        resolved = options.resolve(folder, data, seed, samples, steps, settings, set_)
        dataset, bundle = make_bundle(folder, resolved, jobs)
        if whole:
            bundle = stages.on_test_split(resolved, dataset, bundle)
            left_out = () if slow else SLOW
            asked = [stage for stage in WHOLE_STAGES if stage not in left_out]
        else:
            left_out, asked = (), [stage for stage in STAGES if stage != "loihi"]
        results = [stages.answer(folder, resolved, bundle, s, _say, whole) for s in asked]
        board = folder.check("loihi")
        # A board's result is a row of its own if it is there and of this bundle.
        if not whole and board.exists() and read_result(board)["bundle"] == bundle.id:
            results.append(read_result(board))
        path = folder.whole_ladder if whole else folder.ladder
        table = ladder_json(results, _layers(folder, path, resolved, bundle), left_out)
        write_json(path, table)
        if whole:
            from pipeline.report.confusion import confusion  # imports Matplotlib

            with replacing(folder.confusion) as file:
                confusion(table).savefig(file, format="png", dpi=100)
    if as_json:
        print(json.dumps(table, indent=2))
        return
    if limit is None:
        limit = 1.0 if whole else 3.0
    print("\n" + ladder_text(table, limit))
    if whole:
        print(f"confusion matrices: {folder.confusion}")


def make_bundle(folder, resolved, jobs):
    """Do what is missing up to the bundle; returns the data set and the bundle."""
    dataset = stages.open_dataset(folder, resolved, jobs, _say)
    stages.train(folder, resolved, dataset, _say)
    stages.train_rates(folder, resolved, dataset, _say)
    return dataset, stages.convert(folder, resolved, dataset, _say)


def _layers(folder, path, resolved, bundle):
    """How faithful each layer is on the bundle's samples; from an earlier ladder if it has that."""
    if path.exists():
        earlier = read_json(path, "delete it and run the command again")
        if earlier.get("bundle") == bundle.id and earlier.get("layers"):
            return earlier["layers"]
    images = bundle.checks.images
    activations = rate_activations(resolved, stages.read_weights(folder.snn, resolved), images)
    with progress("compare layers", len(images)) as advance:
        return layers_json(bundle.spec, images, activations, resolved.seed, advance)


def _say(line):
    """What happens goes to standard error, answers to standard output."""
    print(line, file=sys.stderr)
