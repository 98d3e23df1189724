"""How hard recordings are for the paper's CNN, under the paper's protocol.

The simulated people's variation (``parameters.toml``) was set once so that this comes out near the
paper's 0.89; it is not fitted to any other network.
"""

from __future__ import annotations

import numpy as np

from deploy.files import write_json
from pipeline.inputs.dataset import Dataset
from pipeline.progress import progress
from pipeline.settings import Settings
from pipeline.skin.parameters import CALIBRATION

AIM = (0.86, 0.92)
"""Mean accuracy that the built-in recordings are meant to give; the paper has 0.89 (Table 2)."""

RECORD = CALIBRATION.with_name("difficulty.json")
"""The last measurement on the built-in recordings, with their hash."""


def measure(dataset: Dataset, settings: Settings, splits: int = 10) -> list:
    """Test accuracy of the CNN on random splits (paper, Section 3.2).

    Parameters
    ----------
    dataset : Dataset
    settings : Settings
    splits : int

    Returns
    -------
    list of float
        One accuracy a split.
    """
    from pipeline.training.stacked import train_cnns  # TensorFlow takes seconds to import

    seeds = range(splits)
    divided = [dataset.divided(seed, settings.split.test_fraction) for seed in seeds]
    data, parts = (dataset.inputs, dataset.labels), [each.split.train for each in divided]
    with progress("train", settings.cnn.epochs) as advance:
        trained = train_cnns(settings, data, parts, seeds, advance)
    accuracies = []
    for cnn, each in zip(trained, divided, strict=True):
        images, labels = each.part("test")
        accuracies.append(float(np.mean(cnn.logits(images).argmax(1) == labels)))
    return accuracies


def store(dataset: Dataset, accuracies: list):
    """Keep the accuracies beside the simulation's settings, in :data:`RECORD`."""
    source = dataset.recordings.source
    write_json(
        RECORD,
        {
            "source": source.name,
            "sha256": source.sha256,
            "simulated": source.simulated,
            "accuracies": accuracies,
        },
    )
