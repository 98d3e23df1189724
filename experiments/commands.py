"""``python -m experiments``: the paper's Table 2, conversion losses, the value of timing, speed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.errors import CheckFailed, UserError
from deploy.files import write_json
from experiments import choices
from experiments import events as events_
from experiments import losses as losses_
from experiments.table2 import measure_table, table_text
from experiments.table2_splits import MODELS, ON_REQUEST
from pipeline.commands import options
from pipeline.progress import progress
from pipeline.results.study import measure_splits
from pipeline.run import RunFolder

BY_DEFAULT = tuple(name for name in MODELS if name not in ON_REQUEST)
OUT = typer.Option(help="Folder of the results; splits with a result are not run again.")


def table2(
    out: Annotated[Path, OUT] = Path("runs/table2"),
    splits: Annotated[int, typer.Option(help="Number of splits of each kind.", min=1)] = 10,
    models: Annotated[
        str,
        typer.Option(
            help=f"Rows, separated by commas: {', '.join(MODELS)}. Left out by default are "
            "slayer-small, events and events-loihi. SLAYER takes 14 minutes per split, the network "
            "on events 8, all others together less than one.",
            show_default=False,  # without spaces, it could not be wrapped
        ),
    ] = ",".join(BY_DEFAULT),
    kind: Annotated[
        str,
        typer.Option(
            help="Splits: random (the paper's), writers (no writer in both training and test), or "
            "both; by default both where the writers are known."
        ),
    ] = "",
    *,
    given: options.SeededGiven,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Measure the paper's Table 2: mean (SD) over splits, next to the paper's figures.

    An interrupted command continues if it is repeated.  A split that fails is reported, its row is
    the mean of the others, and the exit status is 1.
    """
    names = _names(models)
    with options.opened(out, given) as (folder, resolved):
        found = measure_table(folder, resolved, names, kind, splits, workers, options.say)
    options.conclude(found, table_text, as_json)


def _measure(experiment, out, splits, given, workers, as_json):
    with options.opened(out, given) as (folder, resolved):
        found = measure_splits(experiment, folder, resolved, splits, workers, options.say)
    options.conclude(found, experiment.text, as_json)


def conversion(
    out: Annotated[Path, OUT] = Path("runs/conversion"),
    splits: Annotated[int, typer.Option(help="Number of random splits.", min=1)] = 10,
    *,
    given: options.DataGiven,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Run the paper's networks with the presentations, readouts and rates that it leaves open.

    The result shows which of these choices could explain the paper's losses of 2 points from CNN to
    spiking network and 3 points to Loihi.  An interrupted command continues if it is repeated.
    """
    _measure(choices.EXPERIMENT, out, splits, given, workers, as_json)


def losses(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; seeds with a result are not run again.")
    ] = Path("runs/losses"),
    seeds: Annotated[
        int,
        typer.Option(
            help="Number of seeds, from that of the settings on; each has its own split.", min=1
        ),
    ] = 10,
    *,
    given: options.InputGiven,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Measure the loss from the CNN to the chip on the complete test split, over seeds.

    The target fast stands for the chip: on images with 100 and with 50 steps, on events with the
    steps of the settings.  An interrupted command continues if it is repeated.
    """
    _measure(losses_.EXPERIMENT, out, seeds, given, workers, as_json)


def events(
    out: Annotated[
        Path, typer.Option(help="Folder of the results; existing trainings are not repeated.")
    ] = Path("runs/time"),
    seeds: Annotated[
        int,
        typer.Option(
            help="Number of seeds, from that of the settings on; each has its own split.", min=1
        ),
    ] = 1,
    *,
    given: options.DataGiven,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Measure the value of timing: train on events without polarity, without times, and so on.

    For each seed five variants are trained, minutes each, and tested on the whole test split, on
    the target fast.  An interrupted command continues after the last epoch if it is repeated.
    """
    given = replace(given, input="events")
    _measure(events_.EXPERIMENT, out, seeds, given, workers, as_json)


def emulator(
    bundle: Annotated[
        Optional[Path],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Argument(
            help="Folder of the bundle or of its run.", show_default="runs/default/bundle"
        ),
    ] = None,
    samples: Annotated[
        Optional[int],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Option(help="Use only the first samples of the bundle's check.", min=1),
    ] = None,
    networks: Annotated[
        bool,
        typer.Option("--networks", help="Measure FastSimulator on six networks, without a bundle."),
    ] = False,
    as_json: options.Json = False,
):
    """Compare the speed of NengoLoihi's emulator and the target fast on a bundle's samples.

    Checks that both give the same spikes; exit status 1 if not.
    """
    if networks:
        if bundle is not None or samples is not None:
            raise UserError("--networks measures networks of its own: leave out BUNDLE, --samples")
        from fastloihi import speed

        result = speed.measure()
        options.tell(result, speed.text_of, as_json)
        if not result["identical"]:
            raise CheckFailed("FastSimulator and NengoLoihi's Simulator differ")
        return
    from experiments import emulator_speed  # imports Nengo

    bundle = options.bundle_in(bundle or Path("runs/default/bundle"))
    options.warn_if_outdated(bundle)
    result = emulator_speed.measure(read_bundle(bundle), samples)
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
    run: Annotated[
        Optional[Path],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Argument(help="Folder of a run or of a bundle, whose network is fitted."),
    ] = None,
    data: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Recordings of several writers, not used in RUN's training."),
    ] = None,
    handwriting: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Instead of RUN and --data: PEN, a UNIPEN file of digits. For each fold of its "
            "writers a network is trained on simulated handwriting like that of the other writers, "
            "and fitted to each writer of the fold.",
            metavar="PEN",
        ),
    ] = None,
    folds: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="With PEN: number of folds.", min=2, show_default="3"),
    ] = None,
    fitted: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="With PEN: number of writers from whom the model of handwriting is estimated; 0: "
            "all writers of the other folds.",
            min=0,
            show_default="0",
        ),
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            help="Separated by commas: readout (on the host, as stmnist adapt), wrong-labels (the "
            "same with a tenth of the labels wrong), pes (learning on the chip, in the emulator), "
            "all-layers (training all layers further, only with PEN and events)."
        ),
    ] = "readout",
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="File of the result, or with PEN a folder; folds with a result are not measured "
            "again.",
            show_default="runs/adapt.json, or runs/adapt",
        ),
    ] = None,
    each: Annotated[
        str,
        typer.Option(help="Numbers of recordings of each class to fit to, separated by commas."),
    ] = "1,2,5",
    draws: Annotated[int, typer.Option(help="Number of random draws for each person.", min=1)] = 5,
    *,
    given: options.WithoutDataGiven,
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Measure the gain of fitting a network to one person, as a mean over people.

    With --handwriting PEN, an interrupted command continues if it is repeated.
    """
    from experiments import adaptation, rotation  # Nengo
    from pipeline.results import elsewhere

    counts = _counts(each)
    names = tuple(dict.fromkeys(name.strip() for name in methods.split(",")))
    if unknown := [name for name in names if name not in adaptation.METHODS]:
        raise UserError(
            f"--methods: no method {unknown[0]!r}; they are {', '.join(adaptation.METHODS)}"
        )
    plan = adaptation.Plan(counts, draws, given.seed or 0)
    if handwriting is not None:
        if run is not None or data is not None:
            raise UserError("--handwriting trains networks of its own: leave out RUN and --data")
        with options.opened(out or Path("runs/adapt"), given) as (folder, resolved):
            plan = replace(plan, seed=resolved.seed)
            pen = handwriting.absolute()
            what = rotation.Rotation(pen, plan, folds or 3, fitted or 0, names)
            found = rotation.measure_rotation(what, folder, resolved, workers, options.say)
        options.conclude(found, rotation.rotation_text, as_json)
        return
    if run is None or data is None:
        raise UserError("give RUN and --data, or --handwriting")
    only_with_pen = {
        "--set": given.assignments or None,
        "--settings": given.settings,
        "--input": given.input,
        "--folds": folds,
        "--fitted": fitted,
        "--scheduler": workers.scheduler,
    }
    if unused := [name for name, value in only_with_pen.items() if value is not None]:
        raise UserError(f"{', '.join(unused)}: only with --handwriting, not with RUN and --data")
    folder = RunFolder(run)
    bundle = read_bundle(folder.bundle if folder.bundle.exists() else run)
    options.warn_if_outdated(bundle.path)
    settings = elsewhere.settings_around(bundle)
    recordings = elsewhere.recordings_for(bundle, data, settings, workers.processes, options.say)
    with progress("people", len(np.unique(recordings.writers))) as advance:
        measured = adaptation.measure_adaptation(bundle, recordings, plan, names, advance)
    write_json(out or Path("runs/adapt.json"), measured)
    options.tell(measured, adaptation.adaptation_text, as_json)


def _counts(each):
    try:
        counts = tuple(sorted({int(count) for count in each.split(",")}))
    except ValueError:
        counts = (0,)
    if min(counts) < 1:
        raise UserError(f"--each {each!r}: must be whole numbers from 1 on, separated by commas")
    return counts
