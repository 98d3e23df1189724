"""Splits in which whole styles of writing are new in the test.

ST-MNIST does not tell who wrote a digit, and recordings of one person are alike, so that random
splits reward memory: the nearest training sample has the right class for 97 of 100 digits.  Here
the recordings of each class are clustered, in as many clusters as there were writers, and whole
clusters are held out.  A cluster is no person: this is harder than a new person, whose digits may
be like those of others, and its accuracy is not that on new people.
"""

from dataclasses import replace

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from experiments.classifiers import compute_root_counts
from pipeline.paper import WRITERS
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.splits import Split

# Name of these splits.
STYLES = "styles"

# Share of each class's clusters that is held out is one in this number.
FOLDS = 5


def hold_out_styles(dataset: Dataset, seed: int) -> Dataset:
    """The same samples, with the clusters of one fold of each class as the test set.

    Parameters
    ----------
    dataset : Dataset
        Of any split; its test and training samples are divided anew.
    seed : int
        Of the assignment of clusters to folds, of which the first is held out.
    """
    everything = np.sort(np.concatenate([dataset.split.train, dataset.split.test]))
    features = compute_root_counts(dataset)[everything]
    labels = dataset.labels[everything]
    rng = np.random.default_rng([seed, 0x57E])
    is_test = np.zeros(len(everything), bool)
    for label in np.unique(labels):
        of_class = np.flatnonzero(labels == label)
        cluster = find_clusters(features[of_class])
        names = rng.permutation(np.unique(cluster))
        is_test[of_class] = np.isin(cluster, names[: max(len(names) // FOLDS, 1)])
    split = Split(
        everything[~is_test],
        dataset.split.validation,
        rng.permutation(everything[is_test]),
    )
    return replace(dataset, split=split, origin=dataset.origin.with_content("split", STYLES))


def find_clusters(features) -> np.ndarray:
    """Ward's clusters of recordings of one class, as many as the paper's writers, from 1.

    Parameters
    ----------
    features : ndarray, shape (n_samples, n_features)
    """
    if len(features) < 2:
        return np.ones(len(features), int)
    return fcluster(linkage(features, "ward"), WRITERS, "maxclust")
