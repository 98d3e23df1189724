"""The paper's networks for several splits at once: the same recipe, in a fraction of the time."""

from __future__ import annotations

from models.cnn import build_cnn, get_weights
from models.notation import parse
from models.together import fit_together
from pipeline.settings import Settings
from pipeline.training import Trained, build_rate_network, make_deterministic, snn_recipe


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

    def build():
        return build_cnn(parse(settings.cnn.architecture))

    return _train(build, settings.cnn, data, parts, seeds, advance)


def train_rate_networks(settings: Settings, data, parts, seeds, advance=None) -> list:
    """Train with rate-based LIF neurons from new weights, the paper's recipe (Section 3.2.2).

    Parameters and result as in :func:`train_cnns`.

    Raises
    ------
    ValueError
        The settings ask for another recipe, whose networks are trained one by one.
    """
    if settings.snn.recipe != "paper":
        raise ValueError(f"recipe {settings.snn.recipe!r} is trained by pipeline.training")
    recipe = snn_recipe(settings.snn)
    return _train(lambda: build_rate_network(settings), recipe, data, parts, seeds, advance)


def _train(build, recipe, data, parts, seeds, advance):
    models = []
    for seed in seeds:
        make_deterministic(seed)
        models.append(build())
    histories = fit_together(
        models,
        data,
        parts,
        seeds,
        recipe.epochs,
        recipe.batch_size,
        recipe.learning_rate,
        advance,
    )
    return [Trained(get_weights(m), history) for m, history in zip(models, histories, strict=True)]
