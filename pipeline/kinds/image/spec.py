"""The deployed network of a trained network on images."""

from dataclasses import asdict

from deploy.network.spec import NetworkSpec
from models import chain
from models.architecture import parse_architecture
from pipeline.recordings.dataset import require_images_fit
from pipeline.settings import Settings


def make_network_spec(settings: Settings, weights: dict, provenance: dict, data) -> NetworkSpec:
    """Describe the spiking network on images with the given weights.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the rate-based network.
    provenance : dict
        Stored in the bundle; :attr:`Dataset.provenance` has what other recordings are read with.
    data : (images, labels)
        Training samples, which determine the range of a readout on the chip.

    Raises
    ------
    UserError
        The images cannot be presented to this network.
    """
    images, labels = data
    require_images_fit(images, settings)
    training_logits = None
    if settings.deployment.readout == "chip":
        from pipeline.training.images.networks import TrainedRates

        training_logits = TrainedRates(settings, weights).compute_logits(images), labels
    return make_image_spec(settings, weights, provenance, training_logits)


def make_image_spec(
    settings: Settings, weights: dict, provenance: dict, training_logits=None
) -> NetworkSpec:
    """As :func:`make_network_spec`, with :func:`models.chain.from_rates`'s ``training_logits``."""
    architecture = parse_architecture(settings.cnn.architecture)
    synapse = settings.deployment.synapse_s
    links = chain.from_rates(architecture, weights, settings.snn, synapse, training_logits)
    provenance = {"image": asdict(settings.image), **provenance}  # for other recordings
    return chain.build_network_spec(
        links, settings.stimulus, settings.make_presentation(), provenance
    )
