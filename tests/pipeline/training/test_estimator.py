import numpy as np

from deploy.network.decision import compute_confidence
from pipeline.training.events.estimator import train_estimator


def answers(samples=400, seed=0):
    """Outputs of three classes: the first one leads for good, or is found wrong in the end."""
    rng = np.random.default_rng(seed)
    outputs, right = [], []
    for _ in range(samples):
        steps = int(rng.integers(10, 30))
        first = int(rng.integers(3))
        lead = np.zeros((steps, 3))
        lead[:, first] = np.linspace(1, 6, steps)
        # Class 0 is right from the start; class 1 only in its second half; class 2 never.
        from_step = (0, steps // 2, steps)[first]
        outputs.append(lead + rng.normal(0, 0.1, lead.shape))
        right.append((np.arange(steps) >= from_step) & (outputs[-1].argmax(1) == first))
    return outputs, right


def test_an_estimator_knows_more_than_the_lead():
    estimator = train_estimator(*answers(), seed=0)
    outputs, right = answers(100, seed=1)
    sure = np.concatenate([compute_confidence(sample, estimator) for sample in outputs])
    lead = np.concatenate([compute_confidence(sample) for sample in outputs])
    right = np.concatenate(right)

    def loss(p):
        p = np.clip(p, 1e-6, 1 - 1e-6)
        return -np.mean(np.where(right, np.log(p), np.log(1 - p)))

    assert loss(sure) < 0.5 * loss(lead)
    which = np.concatenate([sample.argmax(1) for sample in outputs])
    assert sure[which == 0].mean() > 0.8 > 0.2 > sure[which == 2].mean()


def test_same_seed_same_estimator():
    one, two, other = (train_estimator(*answers(50), seed=seed) for seed in (1, 1, 2))
    for name, array in one.to_arrays().items():
        np.testing.assert_array_equal(array, two.to_arrays()[name])
    assert any((one.to_arrays()[name] != other.to_arrays()[name]).any() for name in one.to_arrays())
