"""Make a check result of what the reader of NIR answered, so that it can be compared.

``python -m tests.nir_reader.result BUNDLE INPUT.npz OUTPUT.npz RESULT.json``
"""

import sys

import numpy as np

from deploy.check.bundle import read_bundle
from deploy.check.results import write_result
from deploy.check.run import list_sample_records
from deploy.check.summary import make_result
from deploy.files import read_arrays
from deploy.network.responses import compute_responses

REMEDY = "run 'make check-nir' again"


def responses_of(spec, given, answered):
    """The reader's arrays as the responses of a target.

    Parameters
    ----------
    spec : NetworkSpec
    given, answered : dict of str to ndarray
        What went into ``run_norse.py`` and what came out.
    """
    spikes = {"input": (given["spikes"] > 0).sum(1)}
    for layer in spec.layers:
        if layer.neurons is not None:
            spikes[layer.name] = answered[f"spikes.{layer.name}_neurons"]
    flat = {
        name: (np.moveaxis(s, 1, -1) if s.ndim > 2 else s).reshape(len(s), -1).astype(int)
        for name, s in spikes.items()
    }
    readout = spec.layers[-1]
    bias = readout.bias if readout.neurons is None else 0  # NIR has it in the graph's output
    shown = answered["outputs"][:, spec.presentation.gap :]
    return compute_responses(spec, shown - bias, flat)


def main(bundle, given, answered, out):
    opened = read_bundle(bundle)
    reader = read_arrays(answered, REMEDY)
    responses = responses_of(opened.spec, read_arrays(given, REMEDY), reader)
    samples = list_sample_records(opened.checks, responses)
    write_result(out, make_result(opened, "norse", 0, samples, float(reader["seconds"])))


if __name__ == "__main__":
    main(*sys.argv[1:])
