"""Images whose normalisation is not that of a network from elsewhere."""

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.kinds.normalisation import require_images_of_network
from pipeline.recordings.images import make_images_of
from pipeline.settings import Image, Settings
from pipeline.sources import load_dataset


@pytest.fixture(scope="module")
def dataset():
    return load_dataset(Settings().with_values({"data": {"samples_per_digit": 6}}, ""))


@pytest.mark.parametrize("trained_on", ["max", "sqrt-clip"])
def test_the_better_normalisation_is_named(dataset, trained_on):
    """A network that knows each image of its own normalisation, and no other."""
    settings = Settings().with_values({"image": {"normalisation": "max"}}, "")
    images = make_images_of(
        dataset.recordings, Image(normalisation=trained_on), np.arange(len(dataset.labels))
    )
    known = {image.tobytes(): label for image, label in zip(images, dataset.labels, strict=True)}

    def predict(shown):
        return np.array([known.get(image.tobytes(), -1) for image in shown])

    if trained_on == "max":
        require_images_of_network("net", settings, dataset, predict, 40)
        return
    with pytest.raises(UserError, match=r"^net: .* --set image\.normalisation=sqrt-clip"):
        require_images_of_network("net", settings, dataset, predict, 40)
