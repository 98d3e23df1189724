"""``stmnist benchmark``: the paper's Table 2, what conversion costs, what time is worth, speed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.errors import CheckFailed, UserError
from deploy.files import write_json
from pipeline.commands import options
from pipeline.experiments.choices import choices_text, measure_choices
from pipeline.experiments.events import events_text, measure_events
from pipeline.experiments.losses import losses_text, measure_losses
from pipeline.experiments.study import Workers
from pipeline.experiments.table2 import measure_table, table_text
from pipeline.experiments.table2_splits import MODELS, SLOW
from pipeline.inputs.library import load_recordings
from pipeline.progress import progress
from pipeline.run.folder import RunFolder

BY_DEFAULT = tuple(name for name in MODELS if name not in SLOW)
OUT = typer.Option(help="Folder of the results; splits with a result are not run again.")


def table2(
    out: Annotated[Path, OUT] = Path("runs/table2"),
    splits: Annotated[int, typer.Option(help="Splits of each kind.", min=1)] = 10,
    models: Annotated[
        str,
        typer.Option(
            help=f"Rows, separated by commas: {', '.join(MODELS)}. Left out by default "
            "are events and events-loihi, which take minutes a split, and slayer, which takes some "
            "forty.",
            show_default=False,  # one long word without a place to break it
        ),
    ] = ",".join(BY_DEFAULT),
    kind: Annotated[
        str,
        typer.Option(
            help="Splits: random (the paper's), writers (no writer in both training and test), or "
            "both; by default both where the writers are known."
        ),
    ] = "",
    data: options.Data = None,
    seed: options.Seed = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    scheduler: options.Scheduler = None,
    as_json: options.Json = False,
):
    """Measure the paper's Table 2: mean (SD) over splits, next to the paper's figures.

    Goes on where it was interrupted.  A split that fails is reported and its row is of the others;
    exit status 1.
    """
    names, workers = _names(models), Workers(jobs, scheduler)
    with options.opened(out, data, seed, None, None, settings, set_) as (folder, resolved):
        found = measure_table(folder, resolved, names, kind, splits, workers, options.say)
    options.conclude(found, table_text, as_json)


def conversion(
    out: Annotated[Path, OUT] = Path("runs/conversion"),
    splits: Annotated[int, typer.Option(help="Random splits.", min=1)] = 10,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    scheduler: options.Scheduler = None,
    as_json: options.Json = False,
):
    """Run the paper's networks with the presentations, readouts and rates it leaves open.

    Tells what could have cost the paper 2 points from CNN to spiking network and 3 to Loihi.  Goes
    on where it was interrupted.
    """
    workers = Workers(jobs, scheduler)
    with options.opened(out, data, None, None, None, settings, set_) as (folder, resolved):
        found = measure_choices(folder, resolved, splits, workers, options.say)
    options.conclude(found, choices_text, as_json)


def losses(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; seeds with a result are not run again.")
    ] = Path("runs/losses"),
    seeds: Annotated[
        int, typer.Option(help="Seeds, from the settings' own on; one a split.", min=1)
    ] = 10,
    data: options.Data = None,
    input_: options.Input = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    scheduler: options.Scheduler = None,
    as_json: options.Json = False,
):
    """Measure the loss from the CNN to the chip on the complete test split, over seeds.

    The chip is the target fast, of images at 100 and at 50 steps, of events as the settings show
    them.  Goes on where it was interrupted.
    """
    workers = Workers(jobs, scheduler)
    with options.opened(out, data, None, None, None, settings, set_, input_) as opened:
        found = measure_losses(*opened, seeds, workers, options.say)
    options.conclude(found, losses_text, as_json)


def events(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; existing trainings are not repeated.")
    ] = Path("runs/time"),
    seeds: Annotated[
        int, typer.Option(help="Seeds, from the settings' own on; one a split.", min=1)
    ] = 1,
    data: options.Data = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
    scheduler: options.Scheduler = None,
    as_json: options.Json = False,
):
    """Measure the value of timing: train on events without polarity, without times, ...

    Five variants a seed, minutes each, judged on the whole test split by the target fast.  Goes on
    where it was interrupted, after the last epoch.
    """
    workers = Workers(jobs, scheduler)
    with options.opened(out, data, None, None, None, settings, set_, "events") as opened:
        found = measure_events(*opened, seeds, workers, options.say)
    options.conclude(found, events_text, as_json)


def emulator(
    bundle: options.Bundle = Path("runs/default/bundle"),
    samples: Annotated[
        Optional[int],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(help="Use only the first samples of the bundle's check.", min=1),
    ] = None,
    compare_only: Annotated[
        bool,
        typer.Option("--compare-only", help="Leave out the measurements of scaling and limits."),
    ] = False,
    networks: Annotated[
        bool,
        typer.Option("--networks", help="Measure FastSimulator on six networks, not a bundle."),
    ] = False,
    as_json: options.Json = False,
):
    """Compare the speed of NengoLoihi's emulator and the target fast on a bundle's samples.

    Checks that both give the same spikes; exit status 1 if not.
    """
    if networks:
        from pipeline.experiments import network_speed  # imports Nengo

        result = network_speed.measure_networks()
        options.tell(result, network_speed.networks_text, as_json)
        if not result["identical"]:
            raise CheckFailed("FastSimulator and NengoLoihi's Simulator differ")
        return
    from pipeline.experiments import emulator_speed  # imports Nengo

    result = emulator_speed.measure(read_bundle(options.bundle_in(bundle)), samples, compare_only)
    options.tell(result, emulator_speed.speed_text, as_json)
    if not result["identical"]:
        raise CheckFailed("the target fast and NengoLoihi's emulator do not give the same spikes")


def _names(models):
    names = tuple(dict.fromkeys(name.strip() for name in models.split(",") if name.strip()))
    unknown = [name for name in names if name not in MODELS]
    if unknown or not names:
        raise UserError(
            f"--models {models!r}: no model {(unknown or [''])[0]!r}; "
            f"the models are {', '.join(MODELS)}"
        )
    return tuple(name for name in MODELS if name in names)


def adapt(
    run: Annotated[Path, typer.Argument(help="Folder of a run or of a bundle.")],
    data: Annotated[str, typer.Option(help="Recordings of several writers, not used in training.")],
    out: Annotated[Path, typer.Option(help="File of the result, JSON.")] = Path("runs/adapt.json"),
    each: Annotated[
        str, typer.Option(help="Recordings of each class to learn from, separated by commas.")
    ] = "1,2,5",
    draws: Annotated[int, typer.Option(help="Draws for each person.", min=1)] = 5,
    wrong: Annotated[
        float, typer.Option(help="Share of wrong labels to learn from.", min=0, max=0.5)
    ] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed.", parser=options.between(0, 2**31 - 1))] = 0,
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Measure the gain of fitting the readout to a person, over people."""
    from pipeline.experiments.adaptation import adaptation_text, measure_adaptation  # Nengo

    folder = RunFolder(run)
    bundle = read_bundle(folder.bundle if folder.bundle.exists() else run)
    try:
        counts = tuple(sorted({int(count) for count in each.split(",")}))
    except ValueError:
        counts = (0,)
    if min(counts) < 1:
        raise UserError(f"--each {each!r}: whole numbers from 1 on, separated by commas")
    recordings = load_recordings(data, jobs=jobs, warn=options.say)
    with progress("people", len(np.unique(recordings.writers))) as advance:
        measured = measure_adaptation(bundle, recordings, counts, draws, wrong, seed, advance)
    write_json(out, measured)
    options.tell(measured, adaptation_text, as_json)
