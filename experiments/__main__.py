"""``python -m experiments NAME [options]``; without a name, the list of the experiments."""

import sys
from importlib import import_module

from deploy.tables import align_rows
from deploy.terminal import remark, show

# Experiments that are no list of cases: module, what it does, expected time.
OTHERS = {
    "adapt": ("adapt", "The gain of fitting a network to a person", "30 min"),
    "speed": ("speed", "fast and FastSimulator compared with NengoLoihi's emulator", "5 min"),
    "growth": ("growth", "Time and memory of a training, by the number of recordings", "40 min"),
    "stream": ("stream", "Latency of a running sensor's decisions, highest event rate", "4 min"),
    "recurrent": ("recurrent", "A recurrent network from snnTorch on the emulator", "15 min"),
    "calibrate": ("calibration", "Fit the simulation to real recordings", "3 min"),
    "fidelity": ("fidelity", "Compare simulated recordings with real ones", "3 min"),
    "transfer": ("transfer", "Networks trained on simulated recordings, on real ones", "10 min"),
    "pens": ("pens", "Pen trajectories on the sensor of the live page", "1 min"),
    "handwriting": ("handwriting", "Estimate the model of handwriting", "1 min"),
    "tutorials": ("tutorials", "Execute the notebooks of the tutorials", "5 min"),
    "pictures": ("pictures", "Make the pictures of the documents", "1 min"),
    "document": ("document", "Write commands, settings and results into README and docs", "5 s"),
}


def main(arguments=None):
    """Run an experiment, or list all of them; exit status as that of ``stmnist``."""
    from experiments.catalogue import EXPERIMENTS
    from experiments.studies import make_command
    from pipeline.commands.main import run_alone

    name, *words = (sys.argv[1:] if arguments is None else list(arguments)) or [""]
    studies = {experiment.name: experiment for experiment in EXPERIMENTS}
    if name in ("", "-h", "--help"):
        rows = [[e.name, e.title, e.time] for e in EXPERIMENTS]
        rows += [[name, title, time] for name, (_, title, time) in OTHERS.items()]
        show("\n".join(align_rows(rows, left=3)))
        return
    if name in studies:
        verb = make_command(studies[name])
    elif name in OTHERS:
        verb = import_module(f"experiments.{OTHERS[name][0]}").main
    else:
        remark(f"experiments: no experiment {name!r}; 'python -m experiments' lists them")
        sys.exit(2)
    run_alone(verb, f"python -m experiments {name}", words)


if __name__ == "__main__":
    main()
