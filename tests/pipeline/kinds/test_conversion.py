"""What is trained becomes a description of the network that is deployed."""

import numpy as np
import pytest

from deploy.errors import UserError
from models.architecture import parse_architecture
from pipeline.kinds.image.spec import make_network_spec
from pipeline.settings import Settings
from tests.command import call, missing

WEIGHTS = {
    name: np.zeros(shape, np.float32)
    for name, shape in parse_architecture(Settings().cnn.architecture).weight_shapes.items()
}


def test_images_that_cannot_be_spikes_are_refused_before_there_is_a_bundle():
    images = np.zeros((2, 10, 10, 1), np.float32)
    images[1, 4, 5] = 63
    data = images, np.zeros(2, int)
    counts = Settings().with_values({"image": {"normalisation": "none"}})
    with pytest.raises(UserError, match=r"'image.normalisation' 'none'.* 63\b"):
        make_network_spec(counts, WEIGHTS, {}, data)
    slow = {"deployment": {"input_rate": 15.0}}  # 15 x 63 = 945 a second
    make_network_spec(counts.with_values(slow), WEIGHTS, {}, data)


def test_a_run_refuses_them_before_anything_is_trained_or_kept(tmp_path, capsys):
    counts = ("--set", "image.normalisation=none", "--set", "data.samples_per_digit=12")
    assert call("convert", tmp_path / "run", *counts, "--samples", "20") == 2
    assert missing(capsys.readouterr().err, "'image.normalisation'", "'none'") == []
    assert not (tmp_path / "run").exists()
