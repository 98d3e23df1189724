"""Real pen trajectories, pressed on the simulated sensor, as recordings.

Give digits of several people in the UNIPEN format, such as the file of the training writers of
*Pen-Based Recognition of Handwritten Digits* (Alpaydin and Alimoglu, UCI), in this repository's
folder::

    python -m examples.pen FILE pen.zip               # 1,500 digits, drawn at random
    python -m examples.pen FILE reversed.zip reversed  # all strokes written from end to start
    stmnist check run pipeline/live/bundle --data pen.zip --target fast --samples 0
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import stmnist
from experiments import unipen
from pipeline.simulation.simulate import SimulationSetup
from pipeline.sources import load_simulated

if __name__ == "__main__":
    known = [trace for trace in unipen.read(Path(sys.argv[1])) if trace.writer >= 0]
    drawn = np.random.default_rng(1).permutation(len(known))[:1500]
    traces = tuple(known[index] for index in drawn)
    if "reversed" in sys.argv[3:]:
        turned = [tuple(stroke[::-1] for stroke in trace.strokes[::-1]) for trace in traces]
        traces = tuple(replace(t, strokes=s) for t, s in zip(traces, turned, strict=True))
    counts = np.bincount([trace.digit for trace in traces], minlength=10)
    # The skin is pressed like that of the recordings of the live page's network.
    recordings = load_simulated(0, counts, 2, SimulationSetup(traces=traces))
    columns = recordings.taxels.column, recordings.taxels.row
    events = [(*(c[r.taxel] for c in columns), r.time_ns, r.polarity > 0) for r in recordings]
    labels, writers = recordings.labels.tolist(), recordings.writers.tolist()
    pairs = zip(events, labels, strict=True)
    print(stmnist.write_recordings(sys.argv[2], pairs, list("0123456789"), "ns", writers, True))
