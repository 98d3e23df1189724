"""``python -m experiments NAME [options]``; without a name, the list of the experiments."""

from __future__ import annotations

import sys
from importlib import import_module

from deploy.tables import aligned
from deploy.terminal import remark, show

EXPERIMENTS = {
    "table2": ("commands.table2", "the paper's Table 2 on ten splits", "20 min, SLAYER 5 h"),
    "losses": ("commands.losses", "loss from the CNN to the chip, over seeds", "10 min"),
    "choices": ("commands.conversion", "presentations and rates the paper leaves open", "10 min"),
    "events": ("commands.events", "the value of timing: reduced events", "20 min a seed"),
    "adapt": ("commands.adapt", "the gain of fitting a network to a person", "30 min"),
    "speed": ("commands.emulator", "fast beside NengoLoihi's emulator", "15 min"),
    "calibration": ("calibration.main", "fit the simulation to the paper's Table 1", "10 min"),
    "difficulty": ("difficulty.main", "accuracy of the paper's CNN on the recordings", "5 min"),
    "handwriting": ("handwriting.main", "estimate the model of handwriting", "1 min"),
    "document": ("documentation.main", "write the figures into README and docs", "5 s"),
}
"""Each experiment: its function in a module of this package, what it measures, expected time."""


def main(arguments=None):
    """Run an experiment; exit status as that of ``stmnist``."""
    from pipeline.commands.main import run_alone

    name, *options = sys.argv[1:] if arguments is None else arguments
    module, _, function = EXPERIMENTS[name][0].partition(".")
    verb = getattr(import_module(f"experiments.{module}"), function)
    run_alone(verb, f"python -m experiments {name}", options)


def listing() -> str:
    """The experiments, what they measure, and their times on two idle cores."""
    return "\n".join(aligned([[name, *row[1:]] for name, row in EXPERIMENTS.items()], left=3))


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1] in EXPERIMENTS:
        main()
    elif len(sys.argv) > 1 and sys.argv[1] not in ("-h", "--help"):
        remark(f"experiments: no experiment {sys.argv[1]!r}; 'python -m experiments' lists them")
        sys.exit(2)
    else:
        show(listing())
