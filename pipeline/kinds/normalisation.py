"""Compare an imported network on the images of a run and on images with other normalisations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.images import make_images_of

# Normalisations on which a network may have been trained, and the difference in accuracy that
# counts.
COMPARED_NORMALISATIONS = ("max", "sqrt-clip")
MIN_ACCURACY_GAIN = 0.05


def require_images_of_network(path, settings, dataset, predict, max_samples: int):
    """Refuse images that are normalised in another way than those that a network was trained on.

    The network's accuracy tells: own images usually have the default, those of ``Run.dataset`` what
    is chosen for networks that are trained here.

    Parameters
    ----------
    path : path-like
        File of the network.
    settings : Settings
    dataset : Dataset
    predict : callable
        ``predict(images)`` gives the classes.
    max_samples : int
        Maximum number of training samples that are compared.

    Raises
    ------
    UserError
        The network is far better on images with another normalisation.
    """
    rng = np.random.default_rng([settings.seed, 0x1A6])
    indices = np.sort(rng.permutation(dataset.split.train)[:max_samples])
    used = settings.image.normalisation
    right = {}
    for name in {used, *COMPARED_NORMALISATIONS}:
        image = replace(settings.image, normalisation=name)
        images = make_images_of(dataset.recordings, image, indices)
        right[name] = predict(images) == dataset.labels[indices]
    best = max(right, key=lambda name: right[name].sum())
    n_gained = int(right[best].sum() - right[used].sum())
    differing = int((right[best] != right[used]).sum())
    if n_gained > max(MIN_ACCURACY_GAIN * len(indices), 2 * np.sqrt(differing)):
        raise UserError(
            f"{path}: an accuracy of {right[used].mean():.3f} on this run's training images, and "
            f"of {right[best].mean():.3f} on images with another normalisation; give --set "
            f"image.normalisation={best} (or ={used}, to keep this one)"
        )
