"""Recordings in the published representation, and statistics of them that need no label.

See :mod:`pipeline.recordings.chunks`.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.linalg import solve
from scipy.ndimage import label
from scipy.stats import rankdata

from deploy.errors import UserError
from deploy.files import write_json
from deploy.tables import align_rows
from deploy.terminal import show
from pipeline.commands import options
from pipeline.recordings.chunks import CHUNK_NS, CHUNKS, chunk_events
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.sensor import GRID, N_TAXELS, are_digits
from pipeline.simulation.parameters import Population
from pipeline.sources import SimulatedSource, load_recordings

# Slices of a recording for the classifier of digits, and the penalty of its weights.
SLICES = 10
RIDGE = 0.03

# Summaries that are positions or extents, in taxels.
POSITIONS = ("row", "column", "height", "width")

# Taxels, rows and columns that have at least this many bits belong to the digit and not to strays.
MIN_BITS = 2


def chunk_recordings(recordings: Recordings) -> np.ndarray:
    """Recordings as in the published arrays.

    Parameters
    ----------
    recordings : Recordings
        Raw recordings, or some whose times are multiples of :data:`CHUNK_NS`, as in files that were
        made of the published arrays.

    Returns
    -------
    ndarray of bool, shape (n_samples, 100 taxels, 2, 100 chunks)
        The first of the two is a rise of the pressure.

    Raises
    ------
    UserError
        The recordings are not of the paper's sensor.
    """
    taxels = recordings.taxels
    sensor = recordings.sensor
    if (sensor.rows, sensor.columns, sensor.polarities) != (GRID, GRID, 2):
        raise UserError(
            f"{recordings.source.name}: a sensor of {sensor} with {sensor.polarities} polarities; "
            "give recordings of 10x10 taxels with both polarities"
        )
    time = recordings.events.time_ns
    is_chunked = len(time) and not (time % CHUNK_NS).any() and time.max() < CHUNKS * CHUNK_NS
    bits = np.zeros((len(recordings), N_TAXELS, 2, CHUNKS), bool)
    taxel_index = taxels.column * GRID + taxels.row
    for index in range(len(recordings)):
        events = recordings[index] if is_chunked else chunk_events(recordings[index])
        chunk = events.time_ns // CHUNK_NS
        falls = (events.polarity < 0).astype(int)
        bits[index, taxel_index[events.taxel], falls, chunk] = True
    return bits


def summarise_recordings(bits) -> dict:
    """Summaries of each recording, without its label.

    Parameters
    ----------
    bits : ndarray of bool, shape (n, 100, 2, 100)
        See :func:`chunk_recordings`.

    Returns
    -------
    dict of ndarray, shape (n,)
        ``bits``; ``active``, taxels with a bit; ``bits per taxel`` that is active, their mean, and
        ``median bits``; ``largest share`` of the bits in one taxel; ``neighbours`` of an active
        taxel that are active; ``isolated`` share of the active taxels; ``span`` of a taxel from its
        first to its last chunk; ``runs`` of chunks of a taxel, and ``run length``; ``one bit``,
        the share of the active taxels with a single one; ``rise over fall``; ``row`` and
        ``column``, means of the active taxels, from 1; ``height`` and ``width`` of the largest
        component.
    """
    counts = bits.sum(-1, dtype=np.int32)
    total = counts.sum(2)
    active = total > 0
    n_bits = np.maximum(total.sum(1), 1)
    n_active = np.maximum(active.sum(1), 1)
    row = np.arange(N_TAXELS) % GRID
    column = np.arange(N_TAXELS) // GRID
    neighbours = count_neighbours(active)
    any_bit = bits.any(2)
    first = any_bit.argmax(-1)
    last = CHUNKS - 1 - any_bit[..., ::-1].argmax(-1)
    starts = any_bit & ~np.pad(any_bit, ((0, 0), (0, 0), (1, 0)))[..., :-1]
    runs = starts.sum((1, 2))
    height, width = _measure_largest(total >= MIN_BITS)
    median = [np.median(row[row > 0]) if row.any() else 0.0 for row in total]
    return {
        "bits": n_bits,
        "active": n_active,
        "bits per taxel": n_bits / n_active,
        "median bits": np.array(median),
        "largest share": total.max(1) / n_bits,
        "neighbours": (neighbours * active).sum(1) / n_active,
        "isolated": ((neighbours == 0) & active).sum(1) / n_active,
        "span": ((last - first + 1) * active).sum(1) / n_active,
        "runs": runs / n_active,
        "run length": any_bit.sum((1, 2)) / np.maximum(runs, 1),
        "one bit": (total == 1).sum(1) / n_active,
        "rise over fall": counts[..., 0].sum(1) / np.maximum(counts[..., 1].sum(1), 1),
        "row": (active * row).sum(1) / n_active + 1,
        "column": (active * column).sum(1) / n_active + 1,
        "height": height,
        "width": width,
    }


def count_neighbours(active):
    """Number of active taxels around each."""
    grid = np.pad(active.reshape(-1, GRID, GRID), ((0, 0), (1, 1), (1, 1))).astype(np.int32)
    shifted = (grid[:, i : i + GRID, j : j + GRID] for i in range(3) for j in range(3))
    around = sum(shifted) - grid[:, 1:-1, 1:-1]
    return around.reshape(len(active), N_TAXELS)


def _measure_largest(active):
    """Rows and columns of the largest connected component of each recording."""
    sizes = np.zeros((len(active), 2))
    for index, grid in enumerate(active.reshape(-1, GRID, GRID)):
        components, count = label(grid, np.ones((3, 3)))
        if count:
            largest = components == 1 + np.bincount(components.ravel())[1:].argmax()
            sizes[index] = largest.any(0).sum(), largest.any(1).sum()
    return sizes.T


def hold_out_recordings(recordings: Recordings) -> tuple:
    """Real recordings for a fit, and a fifth of them that is held out for a test of it.

    The test part of a published split is in neither.

    Returns
    -------
    fit, held_out : Recordings
    """
    usable = np.flatnonzero([part != "test" for part in recordings.parts])
    order = usable[np.random.default_rng(0).permutation(len(usable))]
    held_out, fit = np.split(order, [len(order) // 5])
    return recordings.subset(np.sort(fit)), recordings.subset(np.sort(held_out))


def classify(train, labels, test) -> np.ndarray:
    """Predictions of a kernel classifier (ridge regression, Gaussian kernel).

    Parameters
    ----------
    train, test : ndarray of bool, shape (n, 100, 2, 100)
        See :func:`chunk_recordings`.
    labels : ndarray of int, shape (n_train,)

    Returns
    -------
    ndarray of int, shape (n_test,)
    """
    train_features = compute_features(train, SLICES)
    test_features = compute_features(test, SLICES)
    kernel = _compute_gaussian(train_features, train_features)
    kernel[np.diag_indices_from(kernel)] += RIDGE
    weights = solve(kernel, 2.0 * np.eye(10)[labels] - 1.0, assume_a="pos", overwrite_a=True)
    return (_compute_gaussian(test_features, train_features) @ weights).argmax(1)


def _compute_gaussian(features, centres):
    """Gaussian kernel whose width is the mean squared length of the features."""
    squares = (features**2).sum(1)[:, None] + (centres**2).sum(1) - 2 * features @ centres.T
    return np.exp(-2 * squares / (centres**2).sum(1).mean())


def compute_features(bits, slices: int) -> np.ndarray:
    """Square roots of the bits of each taxel and polarity in slices of time, shape (n, n_features).

    Parameters
    ----------
    bits : ndarray of bool, shape (n, 100, 2, 100)
    slices : int
        A divisor of 100.
    """
    counts = bits.reshape(*bits.shape[:3], slices, -1).sum(-1, dtype=np.int16)
    return np.sqrt(counts).reshape(len(bits), -1).astype(np.float32)


def tell_apart(real, simulated, seed: int = 0) -> float:
    """Area under the curve of a linear classifier that tells real from simulated recordings.

    Ridge regression on the square roots of the counts of each taxel and polarity, fitted to two
    thirds of the recordings and measured on the other third; 0.5 if they cannot be told apart.
    """
    features = np.concatenate([compute_features(real, 1), compute_features(simulated, 1)])
    is_simulated = np.arange(len(features)) >= len(real)
    order = np.random.default_rng(seed).permutation(len(features))
    test, train = np.split(order, [len(order) // 3])
    mean = features[train].mean(0)
    centred = features - mean
    target = is_simulated[train] - is_simulated[train].mean()
    gram = centred[train].T @ centred[train] + RIDGE * np.eye(features.shape[1])
    score = centred[test] @ solve(gram, centred[train].T @ target, assume_a="pos")
    ranks = rankdata(score)
    positive = is_simulated[test]
    count = positive.sum()
    above = ranks[positive].sum() - count * (count + 1) / 2
    return float(above / count / (len(test) - count))


def compare_summaries(real, labels, simulated, simulated_labels) -> list:
    """Mean of each summary of each digit, real and simulated.

    Returns
    -------
    list of dict
        ``summary``, ``real`` and ``simulated``, ten values each, and ``within``, for how many
        digits they differ by 10 % at most (places: by 0.3 taxel).
    """
    simulated_summaries = summarise_recordings(simulated)
    rows = []
    for name, values in summarise_recordings(real).items():
        means = [float(values[labels == digit].mean()) for digit in range(10)]
        simulated_means = [
            float(simulated_summaries[name][simulated_labels == digit].mean())
            for digit in range(10)
        ]
        limits = [max(0.1 * abs(mean), 0.3 * (name in POSITIONS)) for mean in means]
        errors = np.abs(np.subtract(means, simulated_means))
        within = int((errors <= limits).sum())
        rows.append(
            {"summary": name, "real": means, "simulated": simulated_means, "within": within}
        )
    return rows


def map_activity(bits, labels) -> list:
    """Share of the recordings of each digit in which each taxel is active, ten lists of 100."""
    active = bits.any((2, 3))
    return [np.round(active[labels == digit].mean(0), 2).tolist() for digit in range(10)]


def make_cells(result: dict) -> list:
    """The table of a result: accuracies of the classifier, and means of the summaries."""
    rows = [["", "real", "simulated", "digits within 10 % or 0.3 taxel"]]
    accuracy = result["accuracy"]
    for train in ("real", "simulated"):
        values = [f"{accuracy[f'{train} to {test}']:.3f}" for test in ("real", "simulated")]
        rows.append([f"accuracy, trained on {train} recordings", *values, ""])
    for row in result["summaries"]:
        means = [f"{np.mean(row[kind]):.2f}" for kind in ("real", "simulated")]
        rows.append([row["summary"], *means, f"{row['within']} of 10"])
    return rows


def main(
    data: Annotated[Path, typer.Option(help="Zip or folder of real recordings of digits.")],
    out: Annotated[Path, typer.Option(help="The JSON file to write.")],
    seed: Annotated[int, typer.Option(help="Seed of the simulation.", min=0)] = 0,
    jobs: options.Jobs = 2,
):
    """Compare simulated recordings with real ones, in the form of the published arrays.

    Neither the training nor the fit (``calibrate``) uses a fifth of the real recordings, on which
    the accuracy is measured.  The test part of a published split is not used at all.
    """
    real = load_recordings(str(data), jobs=jobs)
    if not are_digits(real.sensor.classes):
        raise UserError(f"{data}: its classes are not the ten digits; give recordings of digits")
    simulated = SimulatedSource(seed, population=Population(chunked_share=1.0))
    recordings = load_recordings(jobs=jobs, simulated=simulated)
    simulated = chunk_recordings(recordings)
    is_known = np.arange(len(recordings)) % 4 > 0
    trains = {"simulated": (simulated, recordings.labels)}
    tests = {"simulated": (simulated[~is_known], recordings.labels[~is_known])}
    fit, held_out = hold_out_recordings(real)
    trains["real"] = chunk_recordings(fit), fit.labels
    tests["real"] = chunk_recordings(held_out), held_out.labels
    training_recordings = {"simulated": (simulated[is_known], recordings.labels[is_known])}
    bits = np.concatenate([trains["real"][0], tests["real"][0]])
    labels = np.concatenate([fit.labels, held_out.labels])
    cases = {
        f"{train} to {test}": (
            *(training_recordings[train] if train == test == "simulated" else trains[train]),
            *tests[test],
        )
        for train in trains
        for test in tests
    }
    accuracy = {
        name: float((classify(train, classes, test) == truth).mean())
        for name, (train, classes, test, truth) in cases.items()
    }
    result = {
        "experiment": "fidelity",
        "recordings": [real.source.sha256, recordings.source.sha256],
        "held_out": len(held_out),
        "accuracy": accuracy,
        "auc": tell_apart(bits, simulated),
        "summaries": compare_summaries(bits, labels, simulated, recordings.labels),
        "maps": {
            "real": map_activity(bits, labels),
            "simulated": map_activity(simulated, recordings.labels),
        },
    }
    write_json(out, result)
    show("\n".join(align_rows(make_cells(result), left=1)))
    show(f"area under the curve, real against simulated: {result['auc']:.3f}")
