"""Rules that choose how a network on events is trained, and what it reads, for the recordings.

For handwriting on the skin the defaults of the settings are used.  They were chosen on
thousands of recordings of ten classes with few events.  For all other recordings the functions
below choose what suits their number, their classes and their events.  The rules were
cross-validated within the training sets of two sets of real recordings of touch, objects in a
robot's hand and Braille letters.

The refractory period of the input compresses large counts of events, as a square root does, and
saves operations, but it loses events.  Readout weights for sections of a recording tell when
something happened, but there are more of them to learn.  What suits some recordings is estimated in
seconds by a linear classifier on the spikes that the network would receive: ridge regression of the
classes on the spikes of each taxel, polarity and section, each training recording predicted from
all others.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from deploy.arithmetic import divide_up, thin
from pipeline.recordings.recordings import Recordings, is_handwriting
from pipeline.recordings.sensor import Sensor
from pipeline.recordings.spike_frames import EventTable, SpikeLimits
from pipeline.settings import EventTraining, Input

# Number of steps after a sample's last event in which its spikes still reach the outputs.
TAIL_STEPS = 3

# Minimum number of updates of the weights in a training on events.
MIN_UPDATES = 1440

# Updates by the square root of the number of training samples.
UPDATES_BY_ROOT_OF_SAMPLES = 60

# Number of training samples below which there are few, and the dropout of spikes for few.
FEW_SAMPLES = 2000
FEW_DROPOUT = 0.5

# Minimum number of passes over the training samples, unless these take more updates than that.
MIN_EPOCHS = 40
MAX_UPDATES_OF_MIN_EPOCHS = 8000

# Neurons of the hidden layer of a standard network without convolution, for more classes than
# `MANY_CLASSES` and for fewer; and for few samples also with a convolution.
HIDDEN_FEW_SAMPLES = 256
HIDDEN_MANY_CLASSES = 128
HIDDEN = 64
MANY_CLASSES = 10

# Events per recording for which the budgets of the sizes hold; they grow with the events.
USUAL_EVENTS = 500

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


@dataclass(frozen=True)
class NetworkSize:
    """The capacity of a network on events.

    Attributes
    ----------
    name : str
        A value of ``events.size``.
    filters, stride, overlap : int
        Of the convolution; its kernel has ``stride + overlap`` rows and columns.  The stride is for
        ten rows and columns of taxels and grows with them.
    hidden : int
        Neurons of the hidden layer after the convolution.
    width : float
        Neurons of the hidden layer of other networks, in multiples of the standard size's.
    budget : float
        Synaptic operations of a recording of `USUAL_EVENTS`, in multiples of the CNN's.
    passes : int
        Passes over the training samples, in multiples of :func:`choose_epochs`.
    dropout : float
        Share of a layer's neurons whose spikes are left out, unless there are few samples.
    """

    name: str
    filters: int
    stride: int
    overlap: int
    hidden: int
    width: float
    budget: float
    passes: int = 1
    dropout: float = EventTraining.dropout

    def is_for(self, sensor: Sensor, samples: int) -> bool:
        """True if a sensor and a number of training samples suit its convolution."""
        return sensor.is_grid and samples >= FEW_SAMPLES


SIZES = {
    size.name: size
    for size in (
        NetworkSize("small", 24, 3, 1, hidden=64, width=0.5, budget=0.8),
        NetworkSize("standard", 32, 2, 2, hidden=128, width=1.0, budget=2.0),
        NetworkSize("large", 48, 2, 2, hidden=192, width=1.5, budget=3.5, passes=3, dropout=0.2),
    )
}


class InputChoice(NamedTuple):
    """How the events of recordings become input spikes, and how many sections the readout has.

    Attributes
    ----------
    refractory : int
        Refractory period of a taxel and polarity, in steps.
    sections : int
        Number of sections of a recording with readout weights of their own.
    lost : float
        Share of the events that are merged in a step or ignored in the refractory period.
    accuracy, complete : float
        Cross-validated accuracy of the linear classifier with this number of sections, with the
        refractory period and without any.
    """

    refractory: int
    sections: int
    lost: float
    accuracy: float
    complete: float

    def describe(self, step_ms: float, sections: int) -> str:
        """The choice and its reason in a line, with the number of sections that the network has."""
        span = f"each of {sections} sections" if sections > 1 else "the whole"
        return (
            f"refractory period of {self.refractory * step_ms:g} ms: {self.lost:.0%} of the "
            "events are merged or ignored; a linear classifier of the others, cross-validated in "
            f"training, has {self.accuracy:.3f} (of all events {self.complete:.3f}); readout "
            f"weights for {span} of a recording"
        )


def choose_epochs(samples: int, batch_size: int) -> int:
    """Number of passes over the training samples, which has a suitable number of updates.

    Parameters
    ----------
    samples : int
        Number of training samples.
    batch_size : int
        Samples per update.
    """
    batches = divide_up(max(samples, 1), batch_size)
    updates = max(MIN_UPDATES, UPDATES_BY_ROOT_OF_SAMPLES * math.sqrt(samples))
    fewest = min(MIN_EPOCHS, MAX_UPDATES_OF_MIN_EPOCHS // batches)
    return max(round(updates / batches), fewest, 1)


def choose_size(name: str, recordings: Recordings) -> NetworkSize:
    """The size of a network: ``auto`` is small for handwriting that is simulated, else standard.

    Parameters
    ----------
    name : str
        The value of ``events.size``.
    recordings : Recordings
    """
    if name != "auto":
        return SIZES[name]
    source = recordings.source
    is_easy = is_handwriting(recordings) and (source.simulated or source.written)
    return SIZES["small" if is_easy else "standard"]


def choose_hidden_units(size: NetworkSize, samples: int, classes: int) -> int:
    """Neurons of the hidden layer of a network that has few samples or no convolution."""
    hidden = HIDDEN_MANY_CLASSES if classes > MANY_CLASSES else HIDDEN
    if samples < FEW_SAMPLES:
        hidden = HIDDEN_FEW_SAMPLES
    return round(hidden * size.width)


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


def choose_dropout(size: NetworkSize, samples: int) -> float:
    """Dropout for touch that is not simulated handwriting."""
    return FEW_DROPOUT if samples < FEW_SAMPLES else size.dropout


@threadpool_limits.wrap(limits=1, user_api="blas")
def choose_input(table: EventTable, labels, train, step_ms: float, steps: int) -> InputChoice:
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
    steps : int
        Steps of a presentation.
    """
    with_events = np.asarray(train)[np.diff(table.offsets)[train] > 0]
    compared = np.random.default_rng(0x9EAD).permutation(with_events)[:MAX_COMPARED_SAMPLES]
    if len(compared) < 2:
        return InputChoice(0, 1, 0.0, 0.0, 0.0)
    target = np.asarray(labels)[compared]
    lost = {}
    accuracy = {}
    for refractory in REFRACTORY_STEPS:
        lost[refractory] = table.measure_loss(step_ms, refractory)
        is_long = refractory * step_ms > MAX_REFRACTORY_MS
        if refractory and (is_long or lost[refractory] > MAX_LOST_EVENT_SHARE):
            continue
        spikes = _count_spikes(table, compared, step_ms, steps, refractory)
        accuracy[refractory] = {
            sections: measure_left_out_accuracy(_merge_sections(spikes, sections), target)
            for sections in SECTION_COUNTS
        }
    mean = {refractory: np.mean(list(each.values())) for refractory, each in accuracy.items()}
    refractory = max(
        each for each in mean if mean[each] >= max(mean.values()) - MAX_EQUAL_ACCURACY_GAP
    )
    sections = _choose_sections(accuracy[refractory], len(compared))
    return InputChoice(
        refractory=refractory,
        sections=sections,
        lost=lost[refractory],
        accuracy=accuracy[refractory][sections],
        complete=accuracy[0][sections],
    )


def _merge_sections(spikes, sections):
    """Spikes of each sample in fewer sections, shape (n_samples, sections * values)."""
    samples, finest = spikes.shape[:2]
    merged = spikes.reshape(samples, sections, finest // sections, -1).sum(2)
    return merged.reshape(samples, -1)


def _choose_sections(accuracy: dict, samples: int) -> int:
    """The number of sections; a larger one must gain more than a standard error."""
    chosen, *others = SECTION_COUNTS
    for sections in others:
        share = accuracy[chosen]
        standard_error = math.sqrt(share * (1 - share) / samples)
        if accuracy[sections] > share + standard_error:
            chosen = sections
    return chosen


def choose_max_spikes(table: EventTable, train, stimulus: Input, steps: int) -> int:
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
    steps : int
        Number of steps of a presentation.

    Returns
    -------
    int
        0, for no limit, if a taxel that fires all the time has less than twice as many spikes.
    """
    counted = thin(train, MAX_COUNTED_SAMPLES)
    by_batch = [np.zeros(0, int)]
    for start in range(0, len(counted), 64):
        indices = counted[start : start + 64]
        frames = table.make_frames(
            indices, stimulus.step, steps, SpikeLimits(stimulus.refractory_steps)
        )
        by_batch.append(frames.sum(0, dtype=int).ravel())
    counts = np.concatenate(by_batch)
    most = steps // (1 + stimulus.refractory_steps)
    for max_spikes in range(1, most // 2 + 1):
        left_out = np.maximum(counts - max_spikes, 0).sum()
        if left_out <= MAX_LIMITED_SPIKE_SHARE * counts.sum():
            return max_spikes
    return 0


def _count_spikes(table, indices, step_ms, steps, refractory):
    """Spikes of each sample, finest section, taxel and polarity."""
    section = np.arange(steps) * SECTION_COUNTS[-1] // steps
    limits = SpikeLimits(refractory)
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
