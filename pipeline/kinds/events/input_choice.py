"""Rules that choose the input of a network on events: refractory period, sections, spikes.

The refractory period of the input compresses large counts of events, as a square root does, and
saves operations, but it loses events.  Readout weights for sections of a recording tell when
something happened, but there are more of them to learn.  What suits some recordings is estimated in
seconds by a linear classifier on the spikes that the network would receive: ridge regression of the
classes on the spikes of each taxel, polarity and section, each training recording predicted from
all others.
"""

import math
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from deploy.arithmetic import select_evenly
from pipeline.recordings.spike_frames import EventTable, SpikeLimits
from pipeline.settings import Input

# Longest bin of counted events that becomes a step, in milliseconds.
MAX_BIN_MS = 50.0

# Refractory periods, in steps, and numbers of sections of a recording, that are compared.
REFRACTORY_STEPS = (0, 1, 3, 7)
SECTION_COUNTS = (1, 4, 8)

# Maximum share of the spikes that the limit of a taxel's spikes leaves out: on ST-MNIST's training
# set it gives 6, with which one hot taxel costs least, and keeps the accuracy without faults.
MAX_LIMITED_SPIKE_SHARE = 0.15

# Maximum number of training samples whose spikes are counted for that limit.
MAX_COUNTED_SAMPLES = 1000

# Maximum refractory period in milliseconds, and maximum share of the events that it may lose.
MAX_REFRACTORY_MS = 1000
MAX_LOST_EVENT_SHARE = 0.72

# Accuracies this close count as equal: drawing other samples changes them as much.
MAX_EQUAL_ACCURACY_GAP = 0.01

# Strengths of the regularisation of the linear classifier, among which the best is taken.
RIDGES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)

# Maximum number of training samples that the linear classifier is fitted to.
MAX_COMPARED_SAMPLES = 800


class InputChoice(NamedTuple):
    """How the events of recordings become input spikes, and how many sections the readout has.

    Attributes
    ----------
    refractory_steps : int
        Refractory period of a taxel and polarity, in steps.
    n_sections : int
        Number of sections of a recording with readout weights of their own.
    lost : float
        Share of the events that are merged in a step or ignored in the refractory period.
    accuracy, complete : float
        Cross-validated accuracy of the linear classifier with this number of sections, with the
        refractory period and without any.
    """

    refractory_steps: int
    n_sections: int
    lost: float
    accuracy: float
    complete: float

    def describe(self, step_ms: float, n_sections: int) -> str:
        """The choice and its reason in a line, with the number of sections that the network has."""
        span = f"each of {n_sections} sections" if n_sections > 1 else "the whole"
        return (
            f"refractory period of {self.refractory_steps * step_ms:g} ms: {self.lost:.0%} of the "
            "events are merged or ignored; the cross-validated accuracy of a linear classifier is "
            f"{self.accuracy:.3f} on the others and {self.complete:.3f} on all events; readout "
            f"weights for {span} of a recording"
        )


def compute_bin_ms(table: EventTable) -> float | None:
    """The bin in which the events of recordings were counted, or None.

    Returns
    -------
    float or None
        The largest time in milliseconds of which all times are multiples, if it is at least a
        millisecond and at most `MAX_BIN_MS`.
    """
    bin_us = 0
    for _, events in table.select_in_batches():
        time_us = np.rint(1000 * events.time_ms.astype(float)).astype(np.int64)
        bin_us = math.gcd(bin_us, int(np.gcd.reduce(np.unique(time_us), initial=0)))
    bin_ms = bin_us / 1000
    return bin_ms if 1 <= bin_ms <= MAX_BIN_MS else None


@threadpool_limits.wrap(limits=1, user_api="blas")
def choose_input(table: EventTable, labels, train, step_ms: float, n_steps: int) -> InputChoice:
    """Choose the refractory period and the number of sections on the training samples.

    The refractory period is the longest of those with nearly the highest accuracy of the linear
    classifier, on average over all numbers of sections: a longer one saves operations.  There are
    more sections only if they gain more than a standard error.

    Parameters
    ----------
    table : EventTable
    labels : ndarray of int, shape (n_samples,)
    train : ndarray of int
        Indices of the training samples.
    step_ms : float
        Milliseconds of a step.
    n_steps : int
        Steps of a presentation.
    """
    with_events = np.asarray(train)[np.diff(table.offsets)[train] > 0]
    compared = np.random.default_rng(0x9EAD).permutation(with_events)[:MAX_COMPARED_SAMPLES]
    if len(compared) < 2:
        return InputChoice(0, 1, 0.0, 0.0, 0.0)
    target = np.asarray(labels)[compared]
    lost = {}
    accuracy = {}
    for period in REFRACTORY_STEPS:
        lost[period] = table.measure_loss(step_ms, period)
        is_long = period * step_ms > MAX_REFRACTORY_MS
        if period and (is_long or lost[period] > MAX_LOST_EVENT_SHARE):
            continue
        spikes = _count_spikes(table, compared, step_ms, n_steps, period)
        accuracy[period] = {
            sections: measure_left_out_accuracy(_merge_sections(spikes, sections), target)
            for sections in SECTION_COUNTS
        }
    mean = {period: np.mean(list(each.values())) for period, each in accuracy.items()}
    longest = max(
        each for each in mean if mean[each] >= max(mean.values()) - MAX_EQUAL_ACCURACY_GAP
    )
    n_sections = _choose_n_sections(accuracy[longest], len(compared))
    return InputChoice(
        refractory_steps=longest,
        n_sections=n_sections,
        lost=lost[longest],
        accuracy=accuracy[longest][n_sections],
        complete=accuracy[0][n_sections],
    )


def _merge_sections(spikes, sections):
    """Spikes of each sample in fewer sections, shape (n_samples, sections * values)."""
    samples, finest = spikes.shape[:2]
    merged = spikes.reshape(samples, sections, finest // sections, -1).sum(2)
    return merged.reshape(samples, -1)


def _choose_n_sections(accuracy: dict, n_samples: int) -> int:
    """The number of sections; a larger one must gain more than a standard error."""
    chosen, *others = SECTION_COUNTS
    for sections in others:
        share = accuracy[chosen]
        standard_error = math.sqrt(share * (1 - share) / n_samples)
        if accuracy[sections] > share + standard_error:
            chosen = sections
    return chosen


def choose_max_spikes(table: EventTable, train, stimulus: Input, n_steps: int) -> int:
    """Choose the maximum number of spikes of a taxel and polarity in a sample.

    It is the smallest that leaves out at most :data:`MAX_LIMITED_SPIKE_SHARE` of the spikes of the
    training samples.

    Parameters
    ----------
    table : EventTable
    train : ndarray of int
        Indices of the training samples.
    stimulus : Input
        With the length of a step and the refractory period.
    n_steps : int
        Number of steps of a presentation.

    Returns
    -------
    int
        0, for no limit, if a taxel that fires all the time has less than twice as many spikes.
    """
    counted = select_evenly(train, MAX_COUNTED_SAMPLES)
    by_batch = [np.zeros(0, int)]
    for start in range(0, len(counted), 64):
        indices = counted[start : start + 64]
        frames = table.make_frames(
            indices, stimulus.step, n_steps, SpikeLimits(stimulus.refractory_steps)
        )
        by_batch.append(frames.sum(0, dtype=int).ravel())
    counts = np.concatenate(by_batch)
    most = n_steps // (1 + stimulus.refractory_steps)
    for max_spikes in range(1, most // 2 + 1):
        left_out = np.maximum(counts - max_spikes, 0).sum()
        if left_out <= MAX_LIMITED_SPIKE_SHARE * counts.sum():
            return max_spikes
    return 0


def _count_spikes(table, indices, step_ms, steps, refractory_steps):
    """Spikes of each sample, finest section, taxel and polarity."""
    section = np.arange(steps) * SECTION_COUNTS[-1] // steps
    limits = SpikeLimits(refractory_steps)
    counts = []
    for start in range(0, len(indices), 64):
        frames = table.make_frames(indices[start : start + 64], step_ms, steps, limits)
        frames = frames.reshape(*frames.shape[:2], -1)
        counts.append(
            [frames[section == k].sum(0, dtype=np.float32) for k in range(SECTION_COUNTS[-1])]
        )
    return np.concatenate([np.stack(sections, 1) for sections in counts])


def measure_left_out_accuracy(inputs, labels) -> float:
    """Accuracy of ridge regression of the classes, each sample predicted from all others.

    With K the products of the inputs with each other and Y the classes, the fit is H Y with
    H = K (K + ridge)^-1, and a sample that is left out is predicted by y - (y - (H Y)) / (1 - h),
    where h is its entry in the diagonal of H (Golub, Heath and Wahba 1979).

    Parameters
    ----------
    inputs : ndarray, shape (n_samples, n_inputs)
    labels : ndarray of int, shape (n_samples,)

    Returns
    -------
    float
        With the best of the `RIDGES`.
    """
    inputs = inputs - inputs.mean(0)
    products = (inputs @ inputs.T).astype(float)
    products /= max(np.trace(products) / len(inputs), 1e-12)
    products += 1  # an offset for each class
    values, vectors = np.linalg.eigh(products)
    classes = (np.asarray(labels)[:, None] == np.unique(labels)).astype(float)
    projected = vectors.T @ classes
    best = 0.0
    for ridge in RIDGES:
        shrinkage = np.maximum(values, 0) / (np.maximum(values, 0) + ridge)
        fit = vectors @ (shrinkage[:, None] * projected)
        leverage = (vectors**2) @ shrinkage
        left_out = classes - (classes - fit) / np.maximum(1 - leverage, 1e-12)[:, None]
        right = classes[np.arange(len(classes)), left_out.argmax(1)]
        best = max(best, float(right.mean()))
    return best
