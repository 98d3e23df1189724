"""The deployed network of a trained network on images."""

from dataclasses import asdict

from deploy.network.spec import NetworkSpec
from models import chain
from models.architecture import parse
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
    readout_range = None
    if settings.deployment.readout == "chip":
        from pipeline.training.images.networks import TrainedRates

        readout_range = TrainedRates(settings, weights).compute_logits(images), labels
    return make_image_spec(settings, weights, provenance, readout_range)


def make_image_spec(
    settings: Settings, weights: dict, provenance: dict, range_of=None
) -> NetworkSpec:
    """As :func:`make_network_spec`; ``range_of`` is that of :func:`models.chain.from_rates`."""
    architecture = parse(settings.cnn.architecture)
    synapse = settings.deployment.synapse
    links = chain.from_rates(architecture, weights, settings.snn, synapse, range_of)
    provenance = {"image": asdict(settings.image), **provenance}  # for other recordings
    return chain.build_network_spec(
        links, settings.stimulus, settings.make_presentation(), provenance
    )
