"""``stmnist train``, ``convert`` and ``ladder``: the stages of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy.errors import UserError
from pipeline import stages
from pipeline.commands import options
from pipeline.progress import stages as numbered
from pipeline.results.ladder import ladder_text, measure_ladder
from pipeline.roads.answers import LADDER_ONLY, REFERENCES
from pipeline.run import RunFolder, refuse_other_folders


def train(
    run: options.Run,
    given: options.TrainingGiven,
    jobs: options.Jobs = 2,
):
    """Train the paper's CNN on tactile images, or with --input events the network on events."""
    fit = options.fit_recordings(jobs, until="train")
    with (
        options.opened(run, given, fit=fit) as (folder, resolved),
        numbered(stages.bars(resolved, "train")),
    ):
        if resolved.nir.file:  # refused before the settings are saved
            raise UserError(
                f"{run}: its network is the NIR graph {resolved.nir.file}, which is already "
                "trained; use 'stmnist convert', or train a network in a new folder"
            )
        dataset = stages.open_dataset(folder, resolved, jobs, options.say, check=False)
        for name in ("events", "threshold") if resolved.on_events else ("cnn",):
            stages.train(name, folder, resolved, dataset, options.say)
    options.suggest("ladder", run)


def convert(
    run: options.Run,
    given: options.RunGiven,
    model: Annotated[
        Optional[Path],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(
            help="Your Keras model (.keras or .h5), which replaces the CNN; only one you trust."
        ),
    ] = None,
    nir: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="A NIR graph, such as one exported from PyTorch."),
    ] = None,
    step: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="With --nir: milliseconds of the graph's time in a step of the chip."),
    ] = None,
    retrain: Annotated[
        bool,
        typer.Option(
            "--retrain",
            help="With --model: continue training with rate-based LIF.",
        ),
    ] = False,
    jobs: options.Jobs = 2,
):
    """Train the spiking network, on images or with --input events, and write the bundle.

    With --model: scale that model to the neurons' range, make it spike, write the bundle.
    With --nir: turn the graph's neurons and weights into the chip's integers, write the bundle.
    """
    if retrain and model is None:
        raise UserError("--retrain: needs a Keras model; give it with --model FILE")
    if model is not None and nir is not None:
        raise UserError("--model and --nir: a run has one network; give only one of them")
    if step is not None and nir is None:
        raise UserError("--step: needs a NIR graph; give it with --nir FILE")
    changes = stages.settings_of_model(model, retrain) if model else {}
    if nir is not None:
        refuse_other_folders(run)
        changes = stages.settings_of_nir(
            nir, step, given.input, RunFolder(run).resolve_settings(given.settings, {})
        )
    fit = options.fit_recordings(jobs, until="convert")
    with (
        options.opened(run, given, changes, fit) as (folder, resolved),
        numbered(stages.bars(resolved, "convert")),
    ):
        if model is not None and resolved.on_events:
            raise UserError(
                "--model: Keras models receive tactile images; leave out --input events"
            )
        if nir is not None:
            stages.refuse_early(resolved)
        _, bundle = stages.make_bundle(folder, resolved, jobs, options.say)
        for stage in REFERENCES[resolved.network]:
            if stage in LADDER_ONLY:
                continue
            stages.answer(folder, resolved, bundle, stage, options.say)
    options.suggest("ladder", run)


def ladder(
    run: options.Run,
    given: options.RunGiven,
    jobs: options.Jobs = 2,
    whole: Annotated[
        bool, typer.Option("--whole", help="Use the complete test split, not the check's samples.")
    ] = False,
    slow: Annotated[
        bool,
        typer.Option("--slow", help="With --whole: also nengo and simreal, minutes each."),
    ] = False,
    limit: Annotated[
        Optional[float],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(
            help="Loss in points from which a stage's layers are listed (default: 1 with --whole, "
            "else 3, if the loss is significant)."
        ),
    ] = None,
    as_json: options.Json = False,
):
    """Run the missing stages up to the emulator, and print the loss of each stage."""
    if limit is not None and not -100 <= limit <= 100:  # no loss exceeds NaN
        raise UserError(f"--limit {limit:g}: must be from -100 to 100 points")
    if slow and not whole:
        raise UserError("--slow: is for the complete test split; add --whole")
    fit = options.fit_recordings(jobs, until="ladder")
    with options.opened(run, given, fit=fit) as (folder, resolved):
        table = measure_ladder(folder, resolved, jobs, whole, slow, options.say)
    most = limit if limit is not None else 1.0 if whole else 3.0
    asked = limit is not None
    options.tell(table, lambda ladder: "\n" + ladder_text(ladder, most, asked), as_json)
    options.suggest("report", run)
