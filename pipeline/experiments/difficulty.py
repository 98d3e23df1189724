"""How hard recordings are for the paper's CNN, under the paper's protocol.

The simulated people's variation (``parameters.toml``) was set once so that this comes out near the
paper's 0.89; it is not fitted to any other network.
"""

from __future__ import annotations

import numpy as np

from pipeline.skin.parameters import CALIBRATION

AIM = (0.86, 0.92)
"""Mean accuracy that the built-in recordings are meant to give; the paper has 0.89 (Table 2)."""

RECORD = CALIBRATION.with_name("difficulty.json")
"""The last measurement on the built-in recordings, with their hash."""


def measure(recordings, splits=10, settings=None, advance=None) -> list:
    """Test accuracy of the CNN on random 80-20 splits (paper, Section 3.2).

    Parameters
    ----------
    recordings : Recordings
    splits : int
    settings : Settings, optional
        Default: the built-in ones, 20 epochs.
    advance : callable, optional
        ``advance(1, note)`` after each epoch of all networks.

    Returns
    -------
    list of float
        One accuracy a split.
    """
    # TensorFlow takes seconds to import, and whoever only wants the record need not wait for it.
    from pipeline.inputs.images import tactile_images
    from pipeline.inputs.splits import random_split
    from pipeline.settings import Settings
    from pipeline.training.networks import cnn_logits
    from pipeline.training.stacked import train_cnns

    settings = settings or Settings()
    images = tactile_images(recordings, settings.image.aggregation, settings.image.normalisation)
    labels, seeds = recordings.labels, range(splits)
    parts = [random_split(len(labels), seed, settings.split.test_fraction) for seed in seeds]
    trained = train_cnns(settings, (images, labels), [part.train for part in parts], seeds, advance)
    return [
        float(
            np.mean(cnn_logits(settings, cnn.weights, images[p.test]).argmax(1) == labels[p.test])
        )
        for cnn, p in zip(trained, parts, strict=True)
    ]
