"""The losses under choices that the paper leaves open: presentation, readout, rates, first layer.

The paper loses 2 points of accuracy from the CNN to the spiking network and 3 to Loihi (Table 2)
and does not state how long a sample was presented, at which rates neurons fired and how the output
was read.  Here the paper's rate-based networks (Section 3.2.2) are trained once and tested on the
complete test split under each choice.  The reference is the rate-based network itself, which has no
time steps.

Two choices come from published examples that the paper's description (RMSProp, sparse
categorical cross-entropy, rate-based LIF exchanged for spiking LIF) resembles: NengoDL's spiking
MNIST (100 Hz, 30 steps, no synapses, output smoothed over 100 ms and read at the last step), and
NengoLoihi's (100 Hz, samples presented without a gap between them, the first layer off the chip).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256

import numpy as np

from deploy.errors import UserError
from deploy.network.chip import LOIHI
from deploy.tables import aligned
from deploy.targets.registry import answer
from pipeline.artifacts import Origin
from pipeline.paper import points_lost
from pipeline.results.resampling import estimate
from pipeline.results.study import (
    CNN_SETTINGS,
    Experiment,
    Task,
    accuracies,
    counted,
    summary_of_splits,
)
from pipeline.settings import Settings

SCHEMA = "stmnist-conversion/1"
SMOOTHING = 0.1
"""Time constant in seconds of a smoothed output."""


@dataclass(frozen=True)
class Choice:
    """One way to run the trained network.

    Attributes
    ----------
    row : str
        Row of Table 2: ``"ann-snn"`` runs in NengoDL, ``"loihi"`` on the target fast.
    title : str
    max_rate : float
        In Hz, of an activation of 1.
    changes : dict of str to dict
        Settings by section.
    smoothed : bool
        NengoDL only: the smoothed output at the last step decides, else the mean of the steps from
        ``presentation.readout_start`` on.
    """

    row: str
    title: str
    max_rate: float = 150.0
    changes: dict = field(default_factory=dict)
    smoothed: bool = False

    def apply(self, settings: Settings) -> Settings:
        """The settings with this choice."""
        changed = {
            section: replace(getattr(settings, section), **values)
            for section, values in self.changes.items()
        }
        return replace(_trained_as(settings, self.max_rate), **changed)


def _trained_as(settings, max_rate):
    """The settings with the paper's recipe and a maximum rate."""
    return replace(settings, snn=replace(settings.snn, recipe="paper", max_rates=(max_rate,)))


def _steps(steps, **more):
    """A presentation of a number of steps, read in its last four fifths."""
    return {"presentation": {"steps": steps, "readout_start": steps // 5, **more}}


_NO_SYNAPSE = {"deployment": {"synapse": 0.0}}

CHOICES = (
    Choice("ann-snn", "100 steps, the default", changes=_steps(100)),
    *(Choice("ann-snn", f"{n} steps", changes=_steps(n)) for n in (50, 40, 30, 20)),
    Choice("ann-snn", "100 Hz, 100 steps", 100.0, _steps(100)),
    Choice("ann-snn", "100 Hz, 100 steps, unfiltered", 100.0, _steps(100) | _NO_SYNAPSE, True),
    Choice("ann-snn", "100 Hz, 30 steps, unfiltered", 100.0, _steps(30) | _NO_SYNAPSE, True),
    Choice("loihi", "100 steps, the default", changes=_steps(100)),
    *(Choice("loihi", f"{n} steps", changes=_steps(n)) for n in (50, 40, 30)),
    Choice("loihi", "100 steps, no gap", changes=_steps(100, gap=0)),
    Choice("loihi", "50 steps, no gap", changes=_steps(50, gap=0)),
)
"""``unfiltered``: no synapses between the layers, and the smoothed output decides; the others are
read in the last four fifths of the steps.
"""


def refuse(settings: Settings):
    """Refuse settings of a network on events, for which the paper has none of these choices.

    Raises
    ------
    UserError
    """
    if settings.on_events:
        raise UserError(
            "benchmark conversion: trains the paper's networks on images; leave out input.kind = "
            "'events', or use 'python -m experiments losses --input events'"
        )


def result_origin(settings: Settings, dataset: Origin, subject: str = "") -> Origin:
    """The origin of the result of a split."""
    reads = ["input.kind", *CNN_SETTINGS, "snn", "deployment", "presentation"]
    choices = json.dumps([asdict(choice) for choice in CHOICES])
    contents = {"schema": SCHEMA, "choices": sha256(choices.encode()).hexdigest()}
    return Origin.of(settings, reads, [dataset], contents)


def measure(task: Task) -> dict:
    """Train a split's networks and test them under every choice.

    Parameters
    ----------
    task : Task

    Returns
    -------
    dict
        ``seed``, ``n_train``, ``n_test``, the accuracies ``rate`` of the rate-based networks by
        maximum rate, and ``choices``, in the order of :data:`CHOICES`.
    """
    from pipeline.training.networks import train_rate_network  # TensorFlow, where it is needed

    settings, dataset = task.settings, task.dataset()
    images, labels = dataset.part("test")
    weights, rates = {}, {}
    for max_rate in sorted({choice.max_rate for choice in CHOICES}):
        recipe = _trained_as(settings, max_rate)
        net = train_rate_network(recipe, dataset.part("train"), task.seed)
        weights[max_rate] = net.weights
        rates[str(max_rate)] = net.logits(images).argmax(1)
    found = {
        index: _predictions(choice, settings, weights[choice.max_rate], dataset)
        for index, choice in enumerate(CHOICES)
    }
    return {
        **counted(task, dataset),
        "rate": accuracies(rates, labels),
        "choices": list(accuracies(found, labels).values()),
    }


def _predictions(choice, settings, weights, dataset):
    from pipeline.roads.conversion import deployed
    from pipeline.training import nengodl

    chosen = choice.apply(settings)
    images, _ = dataset.part("test")
    if choice.row == "loihi":
        spec = deployed(chosen, weights, {}, dataset.part("train"))
        return answer(spec, images, "fast", chosen.seed).predictions
    steps = chosen.steps
    if choice.smoothed:
        return smoothed(nengodl.run(chosen, weights, images, steps)).argmax(1)
    return nengodl.predict(chosen, weights, images, steps)


def smoothed(outputs) -> np.ndarray:
    """The outputs after a low-pass of :data:`SMOOTHING` seconds, at the last step.

    Parameters
    ----------
    outputs : ndarray, shape (n_samples, steps, n_outputs)

    Returns
    -------
    ndarray, shape (n_samples, n_outputs)
    """
    keep = np.exp(-LOIHI.dt / SMOOTHING)
    weights = (1 - keep) * keep ** np.arange(outputs.shape[1] - 1, -1, -1)
    return np.einsum("t,ntk->nk", weights, outputs)


def summarise(results, simulated: bool) -> dict:
    """Mean accuracy under each choice, and its loss relative to the rate-based network, by split.

    Parameters
    ----------
    results : sequence of dict
        From :func:`measure`.
    simulated : bool

    Returns
    -------
    dict
        Ready for JSON.
    """
    rows = []
    for index, choice in enumerate(CHOICES):
        accuracies = np.array([result["choices"][index] for result in results])
        rates = np.array([result["rate"][str(choice.max_rate)] for result in results])
        loss = estimate(rates - accuracies, results[0]["n_train"], results[0]["n_test"])
        rows.append(
            {
                "row": choice.row,
                "title": choice.title,
                "accuracy": float(accuracies.mean()),
                "loss": loss.mean,
                "loss_ci95": loss.to_json()["ci95"],
            }
        )
    rates = {
        rate: float(np.mean([result["rate"][rate] for result in results]))
        for rate in results[0]["rate"]
    }
    return {
        "schema": SCHEMA,
        **summary_of_splits(results, simulated),
        "rate_accuracy": rates,
        "choices": rows,
    }


def choices_text(summary: dict) -> str:
    """The summary as a table."""
    what = "simulated recordings" if summary["simulated"] else "recordings"
    rates = ", ".join(f"{float(r):g} Hz {a:.3f}" for r, a in summary["rate_accuracy"].items())
    lines = [
        f"The paper's rate-based networks on {what}, {len(summary['seeds'])} random splits, "
        f"{summary['n_test']} test samples each",
        f"accuracy without spikes, by maximum rate: {rates}",
        "unless stated: 150 Hz, and the mean output of the last four fifths of the steps decides",
        "unfiltered: no synaptic filters; the output is smoothed over 100 ms and read at the end",
        "host layer: the first convolution is on the host",
    ]
    for row, heading in (
        ("ann-snn", f"NengoDL (the paper loses {points_lost('ann-snn'):.0f} points)"),
        ("loihi", f"fast (the paper loses {points_lost('loihi'):.0f} points on Loihi)"),
    ):
        rows = [[heading, "accuracy", "points lost", "95 % interval"]]
        for entry in summary["choices"]:
            if entry["row"] == row:
                bounds = entry["loss_ci95"] or ()
                interval = " to ".join(f"{100 * bound:.2f}" for bound in bounds)
                accuracy, lost = f"{entry['accuracy']:.3f}", f"{100 * entry['loss']:.2f}"
                rows.append([entry["title"], accuracy, lost, interval])
        lines += ["", *aligned(rows)]
    return "\n".join(lines)


EXPERIMENT = Experiment(
    "conversion", measure, summarise, result_origin, choices_text, refuse=refuse
)
