"""Experiments that are lists of cases and a table; see :mod:`pipeline.results.study`.

A :class:`Line` is a row of the table: a stage of a network with some changed settings.  It is
measured on each split of each seed.
"""

import datetime
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import write_json
from deploy.tables import align_rows
from experiments import classifiers, readings, tables
from experiments.styles import STYLES, hold_out_styles
from experiments.variants import VARIANTS, vary_dataset
from pipeline import paper
from pipeline.commands import options
from pipeline.kinds.preparation import choose_settings
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.faulty_taxels import FaultCounts, add_faults
from pipeline.results import study
from pipeline.results.study import Case
from pipeline.settings import Provenance, Settings
from pipeline.sources import load_named_recordings
from pipeline.storage.artifacts import Library

# Stored results, from which the documents take their figures.
RESULTS = Path(__file__).resolve().parent.parent / "results"

PAPER = {"snn": {"recipe": "paper"}}
OWN = {"snn": {"recipe": "loihi"}}
READOUT_ON_CHIP = {"deployment": {"readout": "chip"}}


@dataclass(frozen=True)
class Line:
    """A row of an experiment's table.

    Attributes
    ----------
    name, title : str
    stage : str
        See :class:`pipeline.results.study.Case`, or one of :func:`measure`.
    changes : dict
        Changed settings, nested by section.
    input : str
        ``input.kind`` of its network.
    alter : str
        One of :data:`experiments.variants.VARIANTS` or :data:`experiments.readings.READINGS`.
    on_request : bool
        True if the row is only measured if ``--only`` names it.
    styles : bool
        True to measure it also on splits that hold out whole styles, where writers are not known.
    """

    name: str
    title: str
    stage: str
    changes: dict = field(default_factory=dict)
    input: str = "image"
    alter: str = ""
    on_request: bool = False
    styles: bool = False


@dataclass(frozen=True)
class Experiment:
    """A list of lines, and how they are compared.

    Attributes
    ----------
    name, title, time : str
        ``time`` is the expected duration on two idle cores.
    lines : tuple of Line
    pairs : tuple of (str, str)
        Names of lines that are compared, the first minus the second.
    seeds : int
        Default number of seeds, each with its own split.
    writers : bool
        True to measure also on splits with new writers, or, where the writers are not known, with
        new styles (:mod:`experiments.styles`).
    validation : float
        Share of validation samples on which the lines are tested, instead of the test samples, if
        the experiment chooses something; otherwise 0.
    note : str
        What a reader must know.
    """

    name: str
    title: str
    time: str
    lines: tuple
    pairs: tuple = ()
    seeds: int = 10
    writers: bool = False
    validation: float = 0.0
    note: str = ""


# Stages that test a network on the emulated chip with faulty taxels in its test samples.
FAULTY_STAGES = {"fast-hot1": FaultCounts(hot=1), "fast-dead5": FaultCounts(dead=5)}
FAULT_TITLES = {"fast-hot1": "one hot taxel", "fast-dead5": "five dead taxels"}

EMULATED_NOTE = (
    "Emulated Loihi: the target fast, bit-identical to NengoLoihi's emulator; nothing ran on a "
    "chip. Input spikes are made on the host."
)


def _make_chip_line(name, title, changes=None, **more):
    """A network on the emulated chip, with the readout on the host and on the chip."""
    changes = changes or {}
    return (
        Line(name, f"{title}, emulated Loihi, readout on host", "fast", changes, **more),
        Line(f"{name}-chip", f"{title}, emulated Loihi, readout on chip", "fast",
             {**changes, **READOUT_ON_CHIP}, **more),
    )  # fmt: skip


def _with_faults(name, title, changes=None, **more):
    """A network on the emulated chip whose test samples have faulty taxels."""
    return tuple(
        Line(
            f"{name}{stage.removeprefix('fast')}", f"{title}, {fault}", stage, changes or {}, **more
        )
        for stage, fault in FAULT_TITLES.items()
    )


def _make_event_lines(trained, chip, **more):
    """A network on events as trained, and on the emulated chip."""
    title = "SNN on events"
    more = {"input": "events", **more}
    return (
        Line(trained, title, "trained", **more),
        Line(chip, f"{title}, emulated Loihi, readout on host", "fast", **more),
    )


def _make_presentation_line(name, stage, steps, rate=150.0, **sections):
    """The paper's network with choices that the paper leaves open."""
    title = f"{'NengoDL' if stage == 'spiking-lif' else 'emulated Loihi'}, {name}"
    shown = {"steps": steps, "readout_start": steps // 5, **sections.pop("presentation", {})}
    snn = {"recipe": "paper", "max_rates": [rate]}
    changes = {"snn": snn, "presentation": shown, **sections}
    return Line(f"{stage} {name}", title, stage, changes)


CHOICES = (
    Line("rate-lif", "rate-LIF, 150 Hz", "rate-lif", PAPER),
    *(_make_presentation_line(f"{n} steps", "spiking-lif", n) for n in (100, 50, 40, 30, 20)),
    _make_presentation_line("100 steps at 100 Hz", "spiking-lif", 100, 100.0),
    _make_presentation_line(
        "100 steps, no synapse", "spiking-lif", 100, deployment={"synapse": 0.0}
    ),
    *(_make_presentation_line(f"{n} steps", "fast", n) for n in (100, 50, 40, 30)),
    *(
        _make_presentation_line(f"{n} steps, no gap", "fast", n, presentation={"gap": 0})
        for n in (100, 50)
    ),
)

ARCHITECTURES = (
    *("10x10-6c4-24c3-10o", "10x10-12c4s2-64-10o", "10x10-12c3-2a-48-10o"),
    *("10x10-8c3s2p-24c3p-10o", "10x10-16c3s2p-32-10o", "10x10-8c4s2-32c3-10o"),
    *("10x10-12c4s3-48-10o", "10x10-6c4-16c3s2-10o"),
)

# The networks on events have augmentation; this is the CNN with as much of it.
CNN_AUGMENTED = Line(
    "cnn-augmented",
    "CNN, longer training with augmentation",
    "cnn-matched",
    {"cnn": {"augment": "space"}},
    on_request=True,
)

COUNTS = Line("counts", "logistic regression on event counts", "counts", styles=True)

# On the image that is chosen for all networks; the experiment ``readings`` has others.
PAPER_CNN = Line("cnn", "CNN, the paper's recipe", "cnn")

# The experiments, by which ``python -m experiments`` finds them.
EXPERIMENTS = (
    Experiment(
        "table2",
        "The paper's Table 2",
        "2 h; SLAYER 20 h",
        (
            COUNTS,
            Line("kernel", "Gaussian kernel on square roots of counts", "kernel", styles=True),
            Line("nearest", "nearest training sample", "nearest", styles=True),
            PAPER_CNN,
            Line("ann-snn", "ANN-SNN (NengoDL)", "spiking-lif", PAPER),
            *_make_chip_line("loihi", "ANN-SNN", PAPER),
            Line(
                "loihi-200",
                "ANN-SNN, the paper's 200 samples, emulated Loihi, readout on host",
                "fast-200",
                PAPER,
            ),
            Line("slayer", "SNN-SLAYER", "slayer", on_request=True),
            Line(
                "slayer-small",
                "SNN-SLAYER, a tenth of the initial weights",
                "slayer-small",
                on_request=True,
            ),
            Line("cnn-matched", "CNN, longer training", "cnn-matched"),
            CNN_AUGMENTED,
            Line("own-ann-snn", "ANN-SNN (NengoDL), longer training", "spiking-lif", OWN),
            *_make_chip_line("own-loihi", "ANN-SNN, longer training", OWN, styles=True),
            *_make_chip_line("slices", "SNN on slices of time", input="slices", styles=True),
            *_make_event_lines("events", "events-loihi", styles=True),
            Line(
                "events-small-loihi",
                "small SNN on events, emulated Loihi, readout on host",
                "fast",
                {"events": {"size": "small"}},
                input="events",
            ),
            Line(
                "events-large-loihi",
                "large SNN on events, emulated Loihi, readout on host",
                "fast",
                {"events": {"size": "large"}},
                input="events",
            ),
            *_with_faults("own-loihi", "ANN-SNN, longer training, emulated Loihi", OWN),
            *_with_faults("slices", "SNN on slices of time, emulated Loihi", input="slices"),
            *_with_faults("events-loihi", "SNN on events, emulated Loihi", input="events"),
        ),
        (
            *(("ann-snn", "cnn"), ("loihi", "cnn"), ("loihi", "ann-snn"), ("slayer", "cnn")),
            *(("cnn-matched", "cnn"), ("own-ann-snn", "cnn-matched"), ("own-loihi", "cnn-matched")),
            *(("cnn-augmented", "cnn-matched"), ("own-loihi-chip", "own-loihi")),
            *(("events-loihi", "events"), ("events-loihi", "cnn-augmented")),
            *(("slices", "own-loihi"), ("events-loihi", "slices"), ("slices", "kernel")),
        ),
        writers=True,
        note=EMULATED_NOTE,
    ),
    Experiment(
        "losses",
        "What conversion and chip cost, against the CNN with longer training",
        "15 min; events 80 min",
        (
            Line("cnn", "CNN, the paper's recipe", "cnn"),
            Line("cnn-matched", "CNN, longer training", "cnn-matched"),
            Line("rate-lif", "rate-LIF", "rate-lif"),
            Line("spiking-lif", "spiking LIF, NengoDL", "spiking-lif"),
            *(
                line
                for n in (100, 50)
                for line in _make_chip_line(
                    f"chip-{n}", f"{n} steps", {"presentation": {"steps": n}}
                )
            ),
            *_make_event_lines("trained", "events-chip", on_request=True),
        ),
        (
            *((name, "cnn-matched") for name in ("cnn", "rate-lif", "spiking-lif")),
            *((f"chip-{n}{on}", "cnn-matched") for n in (100, 50) for on in ("", "-chip")),
            *(("trained", "cnn-matched"), ("events-chip", "trained")),
        ),
        note=EMULATED_NOTE,
    ),
    Experiment(
        "choices",
        "The paper's networks with presentations and rates that it leaves open",
        "15 min",
        CHOICES,
        tuple((line.name, "rate-lif") for line in CHOICES[1:]),
        note=EMULATED_NOTE,
    ),
    Experiment(
        "events",
        "The value of timing: networks trained and tested on reduced events",
        "20 min a seed",
        (
            *(Line(n, text, "fast", alter=n, input="events") for n, text in VARIANTS.items()),
            CNN_AUGMENTED,
        ),
        tuple((name, "as-is") for name in (*VARIANTS, CNN_AUGMENTED.name) if name != "as-is"),
        seeds=1,
        note=EMULATED_NOTE,
    ),
    Experiment(
        "architectures",
        "Architectures of the network on images, on validation samples",
        "10 min a seed",
        tuple(Line(text, text, "fast", {"cnn": {"architecture": text}}) for text in ARCHITECTURES),
        tuple((text, ARCHITECTURES[0]) for text in ARCHITECTURES[1:]),
        seeds=1,
        validation=0.15,
        note=EMULATED_NOTE,
    ),
    Experiment(
        "real-touch",
        "Recordings of real sensors (--data)",
        "10 min a seed",
        (
            COUNTS,
            Line("cnn", "CNN on images", "cnn"),
            Line("rate-lif", "rate-LIF on images", "rate-lif"),
            Line("chip", "ANN-SNN, emulated Loihi, readout on host", "fast", OWN),
            *_make_event_lines("trained", "events-chip"),
        ),
        (
            *(("chip", "rate-lif"), ("events-chip", "trained"), ("chip", "counts")),
            *(("events-chip", "counts"), ("events-chip", "chip")),
        ),
        seeds=5,
        note=EMULATED_NOTE,
    ),
    Experiment(
        "readings",
        "The paper's CNN on images that the paper's words allow",
        "15 min",
        tuple(
            Line(name, reading.title, readings.STAGE, alter=name)
            for name, reading in readings.READINGS.items()
        ),
        tuple((name, "max") for name in readings.READINGS if name != "max"),
    ),
)


def measure(case: Case, networks: Library) -> dict:
    """As :func:`pipeline.results.study.measure`, also what only experiments have.

    These are stages, and splits that hold out styles.
    """
    if case.split == STYLES:
        case = replace(case, split="random")
        row = _measure_on(hold_out_styles(study.make_dataset(case), case.seed), case, networks)
        return {**row, "split": STYLES}
    return _measure_on(study.make_dataset(case), case, networks)


def _measure_on(dataset, case, networks):
    if case.alter in VARIANTS:
        dataset = vary_dataset(dataset, case.alter, case.seed)
    index = dataset.split.get_indices(case.part)
    if case.stage == readings.STAGE:
        predictions = readings.predict_test_samples(dataset, index, case.alter, case.resolved)
        return study.make_row(case, dataset, index, predictions)
    if case.stage in classifiers.STAGES:
        predictions = classifiers.predict_test_samples(dataset, index, case.stage)
        return study.make_row(case, dataset, index, predictions)
    if case.stage == "fast-200":
        return _draw_check_samples(
            study.measure(replace(case, stage="fast"), networks, dataset), dataset, case
        )
    if case.stage in FAULTY_STAGES:
        return _measure_with_faults(dataset, case, networks)
    if case.stage not in ("slayer", "slayer-small"):
        return study.measure(case, networks, dataset)
    from experiments.slayer import train_and_predict

    scale = 10.0 if case.stage == "slayer-small" else 100.0
    checkpoint = networks.path / case.stage / f"{case.split}-{case.seed:02d}.npz"
    predictions, history = train_and_predict(dataset, index, case.seed, scale, checkpoint)
    return study.make_row(case, dataset, index, predictions, history=history)


def _measure_with_faults(dataset, case, networks):
    """A row of a network on the emulated chip, with faulty taxels in its test samples."""
    on_chip = replace(case, stage="fast")
    opened = study.train(on_chip, networks, dataset)
    faults = FAULTY_STAGES[case.stage]
    faulty = add_faults(dataset.recordings, faults, [case.seed, 0xFA])
    tested = Dataset(faulty, dataset.split, dataset.origin, dataset.settings)
    row = study.evaluate(on_chip, opened, tested)
    return {**row, "stage": case.stage}


def _draw_check_samples(row, dataset, case):
    """A row of all test samples, reduced to those of a check, as many as the paper has."""
    number = min(paper.CHECK_SAMPLES, len(dataset.split.test))
    drawn = dataset.split.check_samples(number, case.seed).tolist()
    at = {sample: place for place, sample in enumerate(row["samples"])}
    places = [at[sample] for sample in drawn]
    right = [row["right"][place] for place in places]
    return {
        **row,
        "predictions": [row["predictions"][place] for place in places],
        "right": right,
        "samples": drawn,
        "stage": case.stage,
        "accuracy": sum(right) / len(drawn),
    }


def list_settings(experiment: Experiment, lines, settings: Settings) -> dict:
    """The settings of each line by its name, without what is chosen for the recordings."""
    always = {"split": {"validation_fraction": experiment.validation}}
    wanted = {}
    for line in lines:
        of_kind = settings.with_values({"input": {"kind": line.input}, **always}, line.name)
        wanted[line.name] = of_kind.with_values(line.changes, line.name)
    return wanted


def fit_settings(wanted: dict, recordings, say) -> dict:
    """The settings of each line with what is chosen for the recordings.

    Parameters
    ----------
    wanted : dict of str to Settings
    recordings : Recordings
    say : callable
        Called once with each message about a choice.
    """
    complete = {}
    by_line = {}
    said = set()

    def say_once(text):
        if text not in said:
            said.add(text)
            say(text)

    for name, settings in wanted.items():
        key = settings, settings.list_names(Provenance.USER)
        if key not in complete:
            complete[key] = choose_settings(settings, recordings, say=say_once)
        by_line[name] = complete[key]
    return by_line


def list_cases(experiment: Experiment, lines, settings: dict, seeds, splits) -> list:
    """The cases of an experiment.

    Parameters
    ----------
    experiment : Experiment
    lines : sequence of Line
    settings : dict of str to Settings
        The settings of each line, see :func:`fit_settings`.
    seeds, splits : iterable
        Seeds, and kinds of splits.
    """
    part = "validation" if experiment.validation else "test"
    return [
        Case(line.name, settings[line.name], line.stage, seed, split, part, line.alter)
        for split in splits
        for seed in seeds
        for line in lines
        if split != STYLES or line.styles
    ]


def run(experiment: Experiment, folder, settings, seeds: int, only: str, workers, say) -> tuple:
    """Measure an experiment's missing rows, and make its table.

    Returns
    -------
    dict, str
        The table, and the failed cases in one line.

    Raises
    ------
    UserError
        There is no such row, or the recordings cannot be read or do not fit.
    """
    lines = select_lines(experiment, only)
    recordings = load_named_recordings(settings, workers.processes, say)
    of_lines = fit_settings(list_settings(experiment, lines, settings), recordings, say)
    splits = list_splits(experiment, settings, recordings)
    folder.save_settings(settings)
    seeds = range(settings.seed, settings.seed + seeds)
    cases = list_cases(experiment, lines, of_lines, seeds, splits)
    sha256 = recordings.source.sha256
    rows, failed = study.run_study(cases, folder.path, sha256, workers, say, measure)
    result = {"experiment": experiment.name, **tables.make_table(rows, against=experiment.pairs)}
    result["measured"] = describe_machine()
    write_json(folder.path / f"{experiment.name}.json", result)
    return result, "; ".join(f"{c.name}, {c.split} {c.seed}: {e}" for c, e in failed.items())


def describe_machine() -> dict:
    """Where and when something was measured: processor, versions and time of the end."""
    return {
        "processor": name_processor(),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("tensorflow", "numpy", "nengo-loihi")},
        "ended": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def list_splits(experiment: Experiment, settings, recordings) -> tuple:
    """The kinds of splits: those of the settings, or random and, where it is asked, by writer."""
    kind = settings.split.kind
    if kind == "auto":
        kind = "published" if recordings.is_split else "random"
    if kind != "random" or not experiment.writers:
        return (kind,)
    are_known = recordings.writers.min(initial=0) >= 0
    return (kind, "writers" if are_known else STYLES)


def select_lines(experiment: Experiment, only: str) -> list:
    """The lines that ``--only`` names, or all that are not on request.

    Raises
    ------
    UserError
    """
    names = [name.strip() for name in only.split(",") if name.strip()]
    known = [line.name for line in experiment.lines]
    if unknown := [name for name in names if name not in known]:
        raise UserError(f"--only: no row {unknown[0]!r}; the rows are {', '.join(known)}")
    return [
        line for line in experiment.lines if (line.name in names if names else not line.on_request)
    ]


def make_cells(experiment: Experiment, found: dict, split: str) -> list:
    """The rows of a table as lists of text, the heads first; the paper's only on random splits."""
    titles = {line.name: line.title for line in experiment.lines}
    paper = experiment.name == "table2" and split == "random"
    early = any("share" in row.get("costs", {}) for row in found["rows"])
    heads = ["accuracy (SD)", "95 % interval", "splits", "operations / CNN", "/ dense"]
    heads += ["neuron updates"]
    heads += ["early after", "early accuracy"] if early else []
    lines = [[f"network, {split} splits", *heads, *(["paper, real data"] if paper else [])]]
    for row in found["rows"]:
        if row["split"] != split:
            continue
        sd = "" if row["sd"] is None else f" ({row['sd']:.3f})"
        interval = tables.format_interval([min(max(b, 0.0), 1.0) for b in row["ci95"] or ()])
        line = [titles[row["name"]], f"{row['mean']:.3f}{sd}", interval, str(len(row["seeds"]))]
        costs = row.get("costs", {})
        shown = COSTS if early else COSTS[:3]
        line += [layout.format(costs[name]) if name in costs else "" for name, layout in shown]
        if paper:
            known = TABLE2.get(row["name"])
            line.append("{:.2f} ({:.2f})".format(*known) if known else "")
        lines.append(line)
    return lines


# Accuracy of each model over the splits, mean and SD (Table 2).
TABLE2 = {
    "cnn": (0.89, 0.01),
    "ann-snn": (0.87, 0.01),
    "loihi": (0.86, 0.02),
    "slayer": (0.81, 0.01),
}

# Costs in a table, and their formats; the last two are the share of a recording until the early
# decision and its accuracy.
COSTS = (
    *(("per_cnn", "{:.2f}"), ("per_dense", "{:.2f}"), ("updates", "{:,.0f}")),
    *(("share", "{:.0%}"), ("early", "{:.3f}")),
)


def format_result(experiment: Experiment, found: dict) -> str:
    """A result as tables."""
    what = "simulated recordings" if found["simulated"] else "recordings"
    lines = [f"{experiment.title}, on {what}: means over splits"]
    for split in dict.fromkeys(row["split"] for row in found["rows"]):
        lines += ["", *align_rows(make_cells(experiment, found, split))]
        if any(len(row["seeds"]) == 1 for row in found["rows"]):
            lines.append("the intervals of a single split are Wilson's, over its test samples")
        elif split == "published":
            lines.append("the intervals are over trainings on this one split")
    if found["comparisons"]:
        titles = {line.name: line.title for line in experiment.lines}
        lines += ["", *align_rows(tables.make_comparison_cells(found, titles))]
    lines += ["", experiment.note]
    lines.append(
        "operations: synaptic, readout included, relative to the multiply-accumulates of the "
        "paper's CNN and of the dense form of the network itself; updates: per inference"
    )
    return "\n".join(lines)


def name_processor() -> str:
    """Name of this machine's processor, and its number of cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor()
    return f"{name}, {os.cpu_count()} cores"


Out = Annotated[Path, typer.Option(help="Folder of the rows, which are not measured again.")]
Store = Annotated[str, typer.Option(help="Name of a file in results/ for the result.")]

Given = Annotated[
    options.RequestedSettings,
    options.group(
        options.RequestedSettings, data=options.Data, seed=options.Seed, **options.CHANGES
    ),
]


def make_command(experiment: Experiment) -> Callable:
    """The command of an experiment."""

    def command(
        out: Out = Path("runs") / experiment.name,
        seeds: Annotated[
            int,
            typer.Option(
                "--seeds",
                "--splits",
                help="Number of splits, each with a seed, from that of the settings on.",
                min=1,
            ),
        ] = experiment.seeds,
        only: Annotated[str, typer.Option(help="Rows, separated by commas.")] = "",
        *,
        given: Given,
        store: Store = "",
        workers: options.Workers,
        as_json: options.Json = False,
    ):
        with options.resolve_settings(out, given, of_results=True) as (folder, settings):
            found, failed = run(experiment, folder, settings, seeds, only, workers, options.say)
        if store and not failed:
            write_json(RESULTS / f"{store}.json", found)
        options.print_summary(
            found, failed, lambda value: format_result(experiment, value), as_json
        )

    command.__doc__ = f"{experiment.title}: {experiment.time}."
    return command
