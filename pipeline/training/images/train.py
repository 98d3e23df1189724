"""Train the paper's CNN, and the same network with rate-LIF neurons."""

from models.architecture import parse_architecture
from models.cnn import build_cnn, get_weights, make_relu, set_weights
from models.keras.keras2 import tf
from pipeline.settings import Settings
from pipeline.training.images.epochs import TrainingSamples, fit_model, make_deterministic
from pipeline.training.images.networks import TrainedCNN, TrainedRates, build_rate_network
from pipeline.training.images.rescaling import fit_to_rates, scale_to_unit
from pipeline.training.images.schedules import make_cnn_schedule, make_snn_schedule


def train_cnn(
    settings: Settings, samples: TrainingSamples, seed: int, advance=None, weights=None
) -> TrainedCNN:
    """Train the paper's CNN (Section 3.2.1).

    Parameters
    ----------
    settings : Settings
    samples : TrainingSamples
    seed : int
        The weights are reproducible on the same kind of processor, for any number of cores, if
        TensorFlow has computed nothing in this process before.
    advance : callable, optional
        ``advance(1, note)`` after each epoch.
    weights : dict, optional
        Weights at the beginning.  Default: new ones.

    Returns
    -------
    TrainedCNN
    """
    model = build_new_cnn(settings, seed)
    if weights is not None:
        set_weights(model, weights)
    schedule = make_cnn_schedule(settings.cnn, len(samples))
    history = fit_model(model, schedule, samples, seed, advance)
    return TrainedCNN(settings, get_weights(model), history)


def train_matched(
    settings: Settings, samples: TrainingSamples, seed: int, cnn_weights, advance=None
) -> TrainedCNN:
    """Train the paper's CNN further, as :func:`train_rate_network` trains the spiking network.

    Both start from the same weights and have the same epochs, annealing, noise, dropout and
    altered images, so that what their accuracies differ by is due to the neurons and the chip's
    weights.

    Parameters
    ----------
    settings, samples, seed, cnn_weights, advance
        As in :func:`train_rate_network`, with ``snn.recipe = "loihi"``.

    Returns
    -------
    TrainedCNN
    """
    make_deterministic(seed)
    snn = settings.snn
    model = build_cnn(
        parse_architecture(settings.cnn.architecture),
        lambda index: make_relu(snn.noise, snn.dropout),
    )
    set_weights(model, scale_to_unit(settings, cnn_weights, samples.images))
    schedule = make_snn_schedule(snn, len(samples))
    history = fit_model(model, schedule, samples, seed, advance)
    return TrainedCNN(settings, get_weights(model), history)


def build_new_cnn(settings: Settings, seed: int) -> tf.keras.Model:
    """The CNN with its initial weights."""
    make_deterministic(seed)
    return TrainedCNN.build(settings)


def train_rate_network(
    settings: Settings, samples: TrainingSamples, seed: int, cnn_weights=None, advance=None
) -> TrainedRates:
    """Train the network with rate-LIF neurons (paper, Section 3.2.2).

    With ``snn.recipe = "as-is"`` it is not trained: the CNN's weights are fitted to the neurons.
    With ``"paper"`` it starts from random weights.  With ``"loihi"`` it starts from the CNN's
    weights, scaled so that the activations fit the neurons' range, and uses the chip's rates and
    weights in the forward pass, noise on the neurons' input, and the settings' penalty on spikes.

    Parameters
    ----------
    settings, samples, seed, advance
        As in :func:`train_cnn`.
    cnn_weights : dict, optional
        Required for ``"loihi"`` and ``"as-is"``.

    Returns
    -------
    TrainedRates
    """
    if settings.snn.recipe == "as-is":
        return TrainedRates(settings, fit_to_rates(settings, cnn_weights, samples.images))
    model = build_new_rate_network(settings, seed, samples.images, cnn_weights)
    schedule = make_snn_schedule(settings.snn, len(samples))
    history = fit_model(model, schedule, samples, seed, advance)
    return TrainedRates(settings, get_weights(model), history)


def build_new_rate_network(
    settings: Settings, seed: int, images, cnn_weights=None
) -> tf.keras.Model:
    """The rate-based network with its initial weights, for training on some images."""
    make_deterministic(seed)
    model = build_rate_network(settings)
    if settings.snn.is_on_chip:
        set_weights(model, scale_to_unit(settings, cnn_weights, images))
    return model
