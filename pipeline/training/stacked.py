"""The networks of several splits at once: the same recipes, in a fraction of the time."""

from __future__ import annotations

from models.cnn import get_weights
from models.together import fit_together
from pipeline.settings import Settings
from pipeline.training.networks import (
    TrainedCNN,
    TrainedRates,
    cnn_recipe,
    new_cnn,
    new_rate_network,
    optimizer,
    snn_recipe,
)


def train_cnns(settings: Settings, data, parts, seeds, advance=None) -> list:
    """Train the paper's CNN on several sets of samples (Section 3.2.1).

    Parameters
    ----------
    settings : Settings
    data : (images, labels)
        Of all samples.
    parts : sequence of ndarray of int
        Training samples of each network.
    seeds : sequence of int
        Of each network's initial weights and order of samples.
    advance : callable, optional
        ``advance(1, note)`` after each epoch of all of them.

    Returns
    -------
    list of TrainedCNN
    """
    models = [new_cnn(settings, seed) for seed in seeds]
    recipe = cnn_recipe(settings.cnn)
    return _train(TrainedCNN, settings, models, recipe, data, parts, seeds, advance)


def train_rate_networks(
    settings: Settings, data, parts, seeds, cnn_weights=None, advance=None
) -> list:
    """Train with rate-based LIF neurons, by either recipe.

    What :func:`pipeline.training.networks.train_rate_network` does, for several splits.  Parameters
    as in :func:`train_cnns`; ``cnn_weights`` are those of each split's CNN, needed for the recipe
    ``"loihi"``.

    Returns
    -------
    list of TrainedRates
    """
    models = [
        new_rate_network(settings, seed, data[0][part], cnn_weights and cnn_weights[index])
        for index, (part, seed) in enumerate(zip(parts, seeds, strict=True))
    ]
    recipe = snn_recipe(settings.snn)
    return _train(TrainedRates, settings, models, recipe, data, parts, seeds, advance)


def _train(kind, settings, models, recipe, data, parts, seeds, advance):
    histories = fit_together(
        models,
        data,
        parts,
        seeds,
        recipe.epochs,
        recipe.batch_size,
        optimizer(recipe, max(len(part) for part in parts)),
        advance,
    )
    return [
        kind(settings, get_weights(model), history)
        for model, history in zip(models, histories, strict=True)
    ]
