"""Measure the gain of fitting a network to a new person, with real pen trajectories.

The people of a UNIPEN file are divided into folds.  For each fold the model of handwriting is
estimated from all other people, a network is trained on recordings simulated with it, and the
fold's own trajectories are pressed on the same simulated sensor.  Of each person, some recordings
of each class are used to fit the readout, as ``stmnist adapt`` does it, and all others to test it.
Several draws of a person are averaged, and intervals are over people.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy import stats as statistics

from deploy.errors import UserError
from deploy.files import hash_file, write_json
from deploy.tables import align_rows
from experiments import handwriting, unipen
from experiments.results import RESULTS, Store, describe_machine
from experiments.tables import format_interval
from pipeline.commands import options
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.progress import hide_progress
from pipeline.recordings.dataset import Dataset, make_dataset_origin, make_split
from pipeline.results.study import Case, run_study
from pipeline.settings import SIMULATED
from pipeline.simulation.parameters import (
    DEFAULT_POPULATION,
    Parameters,
    Population,
    read_parameters,
)
from pipeline.simulation.simulate import SimulationSetup
from pipeline.sources import load_simulated
from pipeline.training.adaptation.adapt import add_rehearsal, require_adaptable_recordings
from pipeline.training.adaptation.refit import Person, fit_readout
from pipeline.training.adaptation.responder import Responder
from pipeline.workflow import open_experiment

FOLDS = 3
# Numbers of recordings of each class to which a network is fitted.
RECORDINGS_PER_CLASS = (1, 2, 5)

MEASURES = ("before", "after", "others_before", "others_after", "used")


@dataclass(frozen=True)
class People:
    """The people of a fold, and a simulation of all others.

    Attributes
    ----------
    traces : tuple of pipeline.simulation.handwriting.Trace
        The trajectories of the people of the fold.
    parameters : pipeline.simulation.parameters.Parameters
        The simulation whose model of handwriting was estimated from the others.
    """

    traces: tuple
    parameters: Parameters


def select_people(pen: Path, fold: int, writers: int = DEFAULT_POPULATION.people) -> People:
    """Every third person of a file.

    Parameters
    ----------
    pen : Path
    fold : int
    writers : int
        Number of simulated people.

    Raises
    ------
    UserError
        The file cannot be read, or too few people remain to estimate the model from.
    """
    traces = unipen.read(pen)
    people = set(sorted({trace.writer for trace in traces if trace.writer >= 0})[fold::FOLDS])
    try:
        others = [trace for trace in traces if trace.writer not in people]
        shapes = handwriting.add_straight_one(handwriting.estimate_shape_model(others))
    except ValueError as error:
        raise UserError(f"{pen}: {error}, without fold {fold}; give more people") from error
    selected = tuple(trace for trace in traces if trace.writer in people)
    return People(selected, replace(read_parameters(Population(writers)), shapes=shapes))


def measure_fold(pen: Path, draws: int, case: Case, networks) -> dict:
    """Train the network of a fold and fit it to each of its people; for :func:`run_study`."""
    settings = case.resolved
    fold = int(case.alter.partition(" ")[2])
    people = select_people(pen, fold, settings.data.writers)
    seed = settings.data.simulation_seed
    samples_per_digit = settings.data.samples_per_digit
    counts = [samples_per_digit] * 10 if samples_per_digit else list(SAMPLES_PER_DIGIT)
    training = load_simulated(seed, counts, 1, SimulationSetup(people.parameters))
    shares = settings.split.test_fraction, settings.split.validation_fraction
    split = make_split(training, case.seed, *shares)
    dataset = Dataset(
        training, split, make_dataset_origin(settings, training.source.sha256), settings
    )
    with hide_progress():
        opened = open_experiment(networks, settings, dataset, lambda line: None)
        opened.make_all()
    spec = opened.make_spec()
    spec = add_rehearsal(spec, dataset.inputs, dataset.labels, split.train, case.seed)
    counts = np.bincount([trace.digit for trace in people.traces], minlength=10)
    setup = SimulationSetup(people.parameters, people.traces)
    recordings = load_simulated(seed, counts, 1, setup)
    cases = list(measure_fits_to_people(spec, dataset.subset("test"), recordings, draws, case.seed))
    return {"recordings": hash_file(pen), "simulated": True, "people": cases}


def measure_fits_to_people(spec, others, recordings, draws: int, seed: int):
    """Fit a network's readout to each person, some of whose recordings it is tested on.

    Parameters
    ----------
    spec : NetworkSpec
        With its rehearsal.
    others : (inputs, labels)
        Samples of other people.
    recordings : Recordings
        Recordings of known writers; those with too few of a class are left out.
    draws, seed : int

    Yields
    ------
    dict
        For each person and number of recordings, ``who``, ``each`` and means over the draws of
        :data:`MEASURES`: accuracies before and after on the person and on others, and the share of
        draws in which the network was changed.
    """
    require_adaptable_recordings(spec, recordings)
    responder = Responder(spec, seed)
    readout = spec.layers[-1]
    rehearsal = spec.rehearsal
    samples_of_others = responder.compute_responses(others[0]), others[1]
    for writer in np.unique(recordings.writers[recordings.writers >= 0]):
        own_recordings = recordings.subset(np.flatnonzero(recordings.writers == writer))
        classes = len(recordings.sensor.classes)
        if np.bincount(own_recordings.labels, minlength=classes).min() <= max(RECORDINGS_PER_CLASS):
            continue
        responses = responder.respond_to(own_recordings)
        copies = responder.respond_to_copies(own_recordings, [seed, int(writer)])
        results = {count: [] for count in RECORDINGS_PER_CLASS}
        for draw in range(draws):
            first, test_indices = split_recordings(own_recordings.labels, [seed, int(writer), draw])
            for count in RECORDINGS_PER_CLASS:
                fitted_indices = first[:, :count].ravel()
                person = Person(
                    responses[fitted_indices],
                    own_recordings.labels[fitted_indices],
                    copies[fitted_indices],
                )
                fit = fit_readout(
                    readout.weights_by_class, readout.bias, person, rehearsal, draw, responder.scale
                )
                weights = fit.weights if fit.helps else readout.weights_by_class
                tested = responses[test_indices], own_recordings.labels[test_indices]
                results[count].append(
                    [
                        _measure_accuracy(readout, readout.weights_by_class, tested),
                        _measure_accuracy(readout, weights, tested),
                        _measure_accuracy(readout, readout.weights_by_class, samples_of_others),
                        _measure_accuracy(readout, weights, samples_of_others),
                        float(fit.helps),
                    ]
                )
        for count, values in results.items():
            means = map(float, np.mean(values, axis=0))
            yield {"who": int(writer), "each": count, **dict(zip(MEASURES, means, strict=True))}


def split_recordings(labels, seed) -> tuple:
    """Indices of the recordings to fit to, a row for each class, and of all others."""
    rng = np.random.default_rng(seed)
    order = [rng.permutation(np.flatnonzero(labels == label)) for label in np.unique(labels)]
    first = np.array([of_class[: max(RECORDINGS_PER_CLASS)] for of_class in order])
    return first, np.concatenate([of_class[max(RECORDINGS_PER_CLASS) :] for of_class in order])


def _measure_accuracy(readout, weights, samples):
    responses, labels = samples
    return float(np.mean((responses @ weights.T + readout.bias).argmax(1) == labels))


def summarise(people) -> list:
    """Means over people, a row for each number of recordings.

    Parameters
    ----------
    people : sequence of dict
        From :func:`measure_fits_to_people`.

    Returns
    -------
    list of dict
        ``each``, number of ``people``, the means of :data:`MEASURES`, the ``gain`` with its 95 %
        interval over people, the ``worst`` person's gain, ``lowest`` and ``highest`` person before.
    """
    rows = []
    for count in sorted({person["each"] for person in people}):
        rows_of_count = [person for person in people if person["each"] == count]
        table = {}
        for name in MEASURES:
            table[name] = np.array([person[name] for person in rows_of_count])
        improvement = table["after"] - table["before"]
        row = {
            "each": count,
            "people": len(rows_of_count),
            **{k: float(v.mean()) for k, v in table.items()},
        }
        mean = float(improvement.mean())
        row |= {"gain": mean, "worst": float(improvement.min()), "ci95": None}
        if len(improvement) > 2:
            error = improvement.std(ddof=1) / np.sqrt(len(improvement))
            reach = float(statistics.t.ppf(0.975, len(improvement) - 1) * error)
            row["ci95"] = [mean - reach, mean + reach]
        row |= {"lowest": float(table["before"].min()), "highest": float(table["before"].max())}
        rows.append(row)
    return rows


def make_cells(result: dict) -> list:
    """The rows of a result as lists of text, the heads first."""
    heads = ["of each digit", "people", "before", "after", "gain, points", "95 % over people"]
    lines = [[*heads, "worst person", "on others", "changed"]]
    for row in result["rows"]:
        improvement = f"{100 * row['gain']:+.1f}"
        worst = f"{100 * row['worst']:+.1f}"
        change_on_others = 100 * (row["others_after"] - row["others_before"])
        lines.append(
            [
                *(str(row["each"]), str(row["people"])),
                *(f"{row[key]:.3f}" for key in ("before", "after")),
                *(improvement, format_interval(row["ci95"], 100, 1, "+"), worst),
                *(f"{change_on_others:+z.1f}", f"{row['used']:.0%}"),
            ]
        )
    return lines


Requested = Annotated[
    options.RequestedSettings,
    options.group_options(
        options.RequestedSettings, seed=options.Seed, input=options.Input, **options.CHANGES
    ),
]


def main(
    pen: Annotated[Path, typer.Argument(help="UNIPEN file of digits of several people.")],
    out: Annotated[Path, typer.Option(help="Folder of the folds, which are kept.")] = Path(
        "runs/adapt"
    ),
    draws: Annotated[int, typer.Option(help="Random draws for each person.", min=1)] = 5,
    *,
    requested: Requested,
    store: Store = "",
    workers: options.Workers,
    as_json: options.Json = False,
):
    """Measure the gain of fitting a network to one person, as a mean over people."""
    with options.lock_and_resolve_settings(out, requested, of_results=True) as (folder, settings):
        if settings.data.source != SIMULATED:
            raise UserError("the networks are trained on simulated recordings; omit data.source")
        pen = pen.absolute()
        name = f"adapt-{settings.input.kind}"
        select_people(pen, 0)  # a wrong file is reported now
        folder.save_settings(settings)
        cases = [
            Case(name, settings, "adapted", settings.seed, alter=f"fold {fold}")
            for fold in range(FOLDS)
        ]
        by = partial(measure_fold, pen, draws)
        rows, failed = run_study(cases, folder.path, hash_file(pen), workers, options.say, by)
    people = [person for row in rows for person in row["people"]]
    result = {"experiment": name, "simulated": True, "pen": hash_file(pen), "draws": draws}
    result |= {"rows": summarise(people), "measured": describe_machine()}
    write_json(out / f"{name}.json", result)
    if store and not failed:
        write_json(RESULTS / f"{store}.json", result)
    title = (
        "real pen trajectories on the simulated sensor, of people on whom no network was trained"
    )
    errors = "; ".join(f"{case.alter}: {error}" for case, error in failed.items())
    text = "\n".join([title, *align_rows(make_cells(result))])
    options.print_summary(result, errors, lambda value: text, as_json)
