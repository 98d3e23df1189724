"""Classifiers without a network, which Table 2 compares with the networks.

Both see the square roots of the numbers of events of each taxel and polarity in equal slices of
time, as :mod:`pipeline.kinds.counts` does.  They were chosen in cross-validation on the training
part of ST-MNIST.
"""

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.recordings.dataset import Dataset

SLICES = 4

# Regularisation of the kernel ridge regression.
RIDGE = 0.03

# Stages that are measured here.
STAGES = ("kernel", "nearest")


# The matrix products take most of the time, and the cases run in several processes.
@threadpool_limits.wrap(limits=1, user_api="blas")
def predict_test_samples(dataset: Dataset, index, stage: str) -> np.ndarray:
    """Predict some samples after fitting a classifier to the training samples.

    Parameters
    ----------
    dataset : Dataset
    index : ndarray of int, shape (n,)
        The samples to predict.
    stage : str
        ``"kernel"``, ridge regression of the classes with a Gaussian kernel whose width is the
        root of half the mean squared distance of training samples; or ``"nearest"``, the class of
        the nearest training sample.

    Returns
    -------
    ndarray of int, shape (n,)
    """
    features = compute_root_counts(dataset)
    labels = dataset.labels
    train = dataset.split.train
    if stage == "nearest":
        from sklearn.neighbors import KNeighborsClassifier  # the import takes a second

        nearest = KNeighborsClassifier(n_neighbors=1, algorithm="brute")
        return nearest.fit(features[train], labels[train]).predict(features[index])
    from sklearn.kernel_ridge import KernelRidge

    classes = np.eye(int(labels.max()) + 1)[labels[train]]
    mean_squared_distance = 2 * features[train].var(0).sum()
    model = KernelRidge(alpha=RIDGE, kernel="rbf", gamma=1 / mean_squared_distance)
    mean = classes.mean(0)  # kernel ridge regression has no offset
    model.fit(features[train], classes - mean)
    return (model.predict(features[index]) + mean).argmax(1)


def compute_root_counts(dataset: Dataset) -> np.ndarray:
    """Square roots of counts, float32, shape (n_samples, slices x taxels x polarities)."""
    table = dataset.recordings.table
    counts = table.count_in_slices(SLICES, table.measure_typical_duration(dataset.split.train))
    return np.sqrt(counts).reshape(len(table), -1)
