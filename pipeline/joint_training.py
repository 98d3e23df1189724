"""The networks of several splits at once: the same recipes, in a fraction of the time."""

from __future__ import annotations

from models.cnn import build_cnn, get_weights, set_weights
from models.notation import parse
from models.together import fit_together
from pipeline.settings import Settings
from pipeline.training import (
    Recipe,
    Trained,
    build_rate_network,
    make_deterministic,
    optimizer,
    scale_to_unit,
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
    list of Trained
    """

    cnn = settings.cnn
    recipe = Recipe(cnn.epochs, cnn.batch_size, cnn.learning_rate)

    def start(index):
        return build_cnn(parse(cnn.architecture))

    return _train(start, recipe, data, parts, seeds, advance)


def train_rate_networks(
    settings: Settings, data, parts, seeds, cnn_weights=None, advance=None
) -> list:
    """Train with rate-based LIF neurons, by either recipe.

    What :func:`pipeline.training.train_rate_network` does, for several splits.  Parameters
    and result as in :func:`train_cnns`; ``cnn_weights`` are those of each split's CNN, needed for
    the recipe ``"loihi"``.
    """
    recipe = snn_recipe(settings.snn)

    def start(index):
        model = build_rate_network(settings)
        if settings.snn.recipe == "loihi":
            set_weights(model, scale_to_unit(settings, cnn_weights[index], data[0][parts[index]]))
        return model

    return _train(start, recipe, data, parts, seeds, advance)


def _train(start, recipe, data, parts, seeds, advance):
    models = []
    for index, seed in enumerate(seeds):
        make_deterministic(seed)
        models.append(start(index))
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
    return [Trained(get_weights(m), history) for m, history in zip(models, histories, strict=True)]
