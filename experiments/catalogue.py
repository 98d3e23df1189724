"""The experiments that are lists of cases and a table: what is measured, and what is compared.

A :class:`Line` is a row of the table: a stage of a network with some changed settings.  It is
measured on each split of each seed (:mod:`experiments.studies`).
"""

from dataclasses import dataclass, field

from experiments import readings
from experiments.variants import VARIANTS
from pipeline.recordings.faulty_taxels import FaultCounts

PAPER_RECIPE = {"snn": {"recipe": "paper"}}
CHIP_RECIPE = {"snn": {"recipe": "loihi"}}
READOUT_ON_CHIP = {"deployment": {"readout": "chip"}}


@dataclass(frozen=True)
class Line:
    """A row of an experiment's table.

    Attributes
    ----------
    name, title : str
    stage : str
        See :class:`pipeline.results.study.Case`, or one of :func:`experiments.measuring.measure`.
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


def _make_chip_lines(name, title, changes=None, **fields):
    """A network on the emulated chip, with the readout on the host and on the chip."""
    changes = changes or {}
    return (
        Line(name, f"{title}, emulated Loihi, readout on host", "fast", changes, **fields),
        Line(f"{name}-chip", f"{title}, emulated Loihi, readout on chip", "fast",
             {**changes, **READOUT_ON_CHIP}, **fields),
    )  # fmt: skip


def _make_faulty_lines(name, title, changes=None, **fields):
    """A network on the emulated chip whose test samples have faulty taxels."""
    return tuple(
        Line(
            f"{name}{stage.removeprefix('fast')}",
            f"{title}, {fault}",
            stage,
            changes or {},
            **fields,
        )
        for stage, fault in FAULT_TITLES.items()
    )


def _make_event_lines(trained, chip, **fields):
    """A network on events as trained, and on the emulated chip."""
    title = "SNN on events"
    fields = {"input": "events", **fields}
    return (
        Line(trained, title, "trained", **fields),
        Line(chip, f"{title}, emulated Loihi, readout on host", "fast", **fields),
    )


def _make_presentation_line(name, stage, steps, rate=150.0, **sections):
    """The paper's network with choices that the paper leaves open."""
    title = f"{'NengoDL' if stage == 'spiking-lif' else 'emulated Loihi'}, {name}"
    presentation = {"steps": steps, "readout_start": steps // 5, **sections.pop("presentation", {})}
    snn = {"recipe": "paper", "max_rates": [rate]}
    changes = {"snn": snn, "presentation": presentation, **sections}
    return Line(f"{stage} {name}", title, stage, changes)


CHOICES = (
    Line("rate-lif", "rate-LIF, 150 Hz", "rate-lif", PAPER_RECIPE),
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
            Line("ann-snn", "ANN-SNN (NengoDL)", "spiking-lif", PAPER_RECIPE),
            *_make_chip_lines("loihi", "ANN-SNN", PAPER_RECIPE),
            Line(
                "loihi-200",
                "ANN-SNN, the paper's 200 samples, emulated Loihi, readout on host",
                "fast-200",
                PAPER_RECIPE,
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
            Line("own-ann-snn", "ANN-SNN (NengoDL), longer training", "spiking-lif", CHIP_RECIPE),
            *_make_chip_lines("own-loihi", "ANN-SNN, longer training", CHIP_RECIPE, styles=True),
            *_make_chip_lines("slices", "SNN on slices of time", input="slices", styles=True),
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
            *_make_faulty_lines(
                "own-loihi", "ANN-SNN, longer training, emulated Loihi", CHIP_RECIPE
            ),
            *_make_faulty_lines("slices", "SNN on slices of time, emulated Loihi", input="slices"),
            *_make_faulty_lines("events-loihi", "SNN on events, emulated Loihi", input="events"),
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
                for line in _make_chip_lines(
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
            Line("chip", "ANN-SNN, emulated Loihi, readout on host", "fast", CHIP_RECIPE),
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
