"""``stmnist train``, ``convert`` and ``ladder``: the stages of a run."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.terminal import remark
from pipeline.commands import options
from pipeline.storage.run_folder import RunFolder, require_run_or_new_folder


def train(run: options.Run, requested: options.TrainingRequested, jobs: options.Jobs = 2):
    """Train the paper's CNN on tactile images, or with --input events the network on events."""

    from pipeline.kinds.registry import find_kind  # imports all that a run is made with

    def require_training(settings):
        return find_kind(settings).trained_steps  # an error if the network was trained elsewhere

    with options.open_requested_run(
        run, requested, jobs, needs_check=False, validate=require_training
    ) as opened:
        for name in opened.kind.trained_steps:
            opened.make(name)
    options.suggest("ladder", run)


def convert(  # noqa: PLR0913 - each is an option of the command
    run: options.Run,
    requested: options.RunRequested,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Your Keras model (.keras or .h5), which replaces the CNN; only one you trust."
        ),
    ] = None,
    nir: Annotated[
        Path | None, typer.Option(help="A NIR graph, such as one exported from PyTorch.")
    ] = None,
    step: Annotated[
        float | None,
        typer.Option(help="With --nir: milliseconds of the recording in a step of the network."),
    ] = None,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="With --nir: refuse a graph trained with another reset."),
    ] = False,
    retrain: Annotated[
        bool, typer.Option("--retrain", help="With --model: continue training with rate-LIF.")
    ] = False,
    jobs: options.Jobs = 2,
):
    """Train the spiking network, on images or with --input events, and write the bundle.

    With --model: scale that model to the neurons' range, make it spike, write the bundle.
    With --nir: turn the graph's neurons and weights into the chip's integers, write the bundle.
    """
    from pipeline import workflow

    imported = workflow.ImportRequest(
        model=model, nir=nir, step_ms=step, retrain=retrain, strict=strict, prefix="--"
    )
    changes = {}
    if model is not None or nir is not None:
        require_run_or_new_folder(run)
        folder = RunFolder(run)
        before = folder.resolve_settings(requested.settings, {})
        kept = folder if requested.settings is None else None
        changes = imported.make_settings(before, requested.input, kept)
    if step is not None and changes["input"]["kind"] == "image":
        remark(f"--step {step:g} is not used: images have no steps of a recording")
    with options.open_requested_run(
        run, requested, jobs, changes, validate=imported.require_convertible
    ) as opened:
        workflow.convert_and_check(opened)
    options.suggest("ladder", run)


def ladder(
    run: options.Run,
    requested: options.RunRequested,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Run the missing stages up to the emulator, and print the loss of each stage."""
    from pipeline.results.ladder import format_ladder, measure_ladder

    with options.open_requested_run(run, requested, jobs) as opened:
        table = measure_ladder(opened, jobs)
    options.print_result(table.to_dict(), lambda _: "\n" + format_ladder(table), as_json)
    options.suggest("report", run)
