"""Frames of the built-in events for PyTorch: ``python -m tests.nir_networks.frames FILE STEP_MS``.

Into the file go ``frames``, uint8 of shape (samples, steps, 2, rows, columns), eight to a byte
along the flattened rest of a sample; ``shape``; ``labels``; and the indices ``train`` and ``test``
of the split of seed 0.
"""

import sys

import numpy as np

from deploy.files import write_arrays
from pipeline.settings import Settings
from pipeline.sources import load_dataset


def main(file, step_ms, samples_per_digit=0):
    changes = {
        "input": {"kind": "events", "step": float(step_ms), "refractory": 0.0},
        "data": {"samples_per_digit": int(samples_per_digit)},
    }
    dataset = load_dataset(Settings().with_values(changes, "frames"))
    frames = np.moveaxis(dataset.inputs, -1, 2)
    write_arrays(
        file,
        frames=np.packbits(frames.reshape(len(frames), -1), axis=1),
        shape=np.array(frames.shape),
        labels=dataset.labels,
        train=dataset.split.train,
        test=dataset.split.test,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
