"""Tables of measured rows: means over splits with their intervals, and paired comparisons.

The splits of a study share most of their training samples, so that their accuracies are not
independent and the usual t interval is too narrow.  Nadeau and Bengio (2003, "Inference for the
generalization error", Section 3.3) widen the variance of the mean from s^2/J to (1/J + n_test /
n_train) s^2.
"""

import numpy as np
from scipy import stats

from deploy.check.intervals import compute_mcnemar_p, compute_wilson_interval
from deploy.tables import format_p

# Fewest splits for an interval.
MIN_SPLITS = 3


def make_table(rows, by=("split", "name"), against=()) -> dict:
    """Means over splits, and differences on the same samples of the same splits.

    Parameters
    ----------
    rows : sequence of dict
        From :func:`pipeline.results.study.run_study`.
    by : sequence of str
        Rows with equal entries of these names are averaged; the last one names the row.
    against : sequence of (str, str)
        Pairs of names that are compared, the first one minus the second: a loss is negative.

    Returns
    -------
    dict
        ``rows``: the entries of ``by``, the ``seeds``, the ``values`` of the splits, their
        ``mean`` and the values of :func:`estimate_mean`, and means of ``costs``.
        ``comparisons``: ``a``, ``b``, difference (``mean``, ``ci95``), ``agreement`` of the
        predictions, ``p`` and ``p_holm``, corrected for
        the number of comparisons.
    """
    groups = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in by), {})[row["seed"]] = row
    entries = []
    for key, of_seed in groups.items():
        runs = list(of_seed.values())
        values = [row["accuracy"] for row in runs]
        entry = {**dict(zip(by, key, strict=True)), "seeds": list(of_seed), "values": values}
        entry |= {size: _compute_mean(runs, size) for size in ("n_train", "n_test")}
        entry |= estimate_mean(values, entry["n_train"], entry["n_test"], runs[0]["split"])
        if len(runs) == 1:
            right = runs[0]["right"]
            entry["ci95"] = list(compute_wilson_interval(sum(right), len(right)))
        costs = [row["costs"] for row in runs if "costs" in row]
        if len(costs) == len(runs):
            names = [name for name, value in costs[0].items() if not isinstance(value, dict)]
            entry["costs"] = {name: _compute_mean(costs, name) for name in names}
        entries.append(entry)
    comparisons = [
        {**dict(zip(by, key, strict=True)), "a": key[-1], "b": b, **difference}
        for a, b in against
        for key in groups
        if key[-1] == a
        and (difference := _compare_rows(groups[key], groups.get((*key[:-1], b), {})))
    ]
    for comparison, p in zip(
        comparisons, correct_by_holm([c["p"] for c in comparisons]), strict=True
    ):
        comparison["p_holm"] = p
    return {
        "simulated": any(row["simulated"] for row in rows),
        "recordings": sorted({row["recordings"] for row in rows}),
        "rows": entries,
        "comparisons": comparisons,
    }


def _compute_mean(rows, name):
    return float(np.mean([row[name] for row in rows]))


def _compare_rows(rows, other_rows):
    """Accuracy of one row minus another's, over their common seeds and samples."""
    seeds = [seed for seed in rows if seed in other_rows]
    if not seeds:
        return None
    pairs = [(rows[seed], other_rows[seed]) for seed in seeds]
    differences = [float(np.subtract(*_pair_common(*pair)).mean()) for pair in pairs]
    shared = [row for row, _ in pairs]
    sizes = [_compute_mean(shared, name) for name in ("n_train", "n_test")]
    comparison = estimate_mean(differences, *sizes, pairs[0][0]["split"])
    if len(pairs) == 1:
        comparison["p"] = compute_mcnemar_p(*_pair_common(*pairs[0]))
    agree = [np.mean(np.equal(*_pair_common(*pair, "predictions"))) for pair in pairs]
    return {**comparison, "values": differences, "agreement": float(np.mean(agree))}


def _pair_common(row, other_row, entry="right"):
    """An entry of two rows for each sample that both have."""
    of_row = dict(zip(row["samples"], row[entry], strict=True))
    of_other = dict(zip(other_row["samples"], other_row[entry], strict=True))
    shared = sorted(of_row.keys() & of_other.keys())
    return [
        np.array([of_row[sample] for sample in shared]),
        np.array([of_other[sample] for sample in shared]),
    ]


def estimate_mean(values, n_train: float, n_test: float, split: str = "random") -> dict:
    """Mean over splits, with the corrected resampled t statistic.

    Parameters
    ----------
    values : array_like, shape (n_splits,)
        An accuracy, or a difference of two accuracies, of each split.
    n_train, n_test : float
        Samples of each split, or their mean where splits differ: the shares of the split itself,
        whatever part of the test samples was evaluated.
    split : str
        Kind of the split.  With ``"published"`` only the training differs between seeds: there is
        no correction, and the interval is of the mean over trainings on this one split.

    Returns
    -------
    dict
        ``mean``; ``sd`` over the splits, 95 % interval ``ci95`` of the mean and two-sided ``p`` of
        a mean of zero, which are None for fewer splits than :data:`MIN_SPLITS`.
    """
    values = np.asarray(values, float)
    n = len(values)
    mean = float(values.mean())
    if n < MIN_SPLITS:
        return {"mean": mean, "sd": None, "ci95": None, "p": None}
    sd = float(values.std(ddof=1))
    overlap = 0.0 if split == "published" else n_test / n_train
    error = sd * np.sqrt(1 / n + overlap)
    reach = float(stats.t.ppf(0.975, n - 1) * error)
    p = float(2 * stats.t.sf(abs(mean) / error, n - 1)) if error else float(mean == 0)
    return {"mean": mean, "sd": sd, "ci95": [mean - reach, mean + reach], "p": p}


def correct_by_holm(p_values) -> list:
    """p values corrected for their number (Holm 1979); None stays None and is not counted."""
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        corrected[index] = largest
    return corrected


def format_interval(ci95, scale: float = 1.0, digits: int = 3, sign: str = "") -> str:
    """An interval as "0.870 to 0.912"; empty without one."""
    return " to ".join(f"{scale * bound:{sign}.{digits}f}" for bound in ci95 or ())


def make_comparison_cells(table: dict, titles: dict) -> list:
    """The comparisons of a table as lists of text, the heads first; a loss is negative.

    Parameters
    ----------
    table : dict
        From :func:`make_table`.
    titles : dict of str to str
        What each name of a row is called.
    """
    rows = []
    for entry in table["comparisons"]:
        p = "" if entry["p_holm"] is None else format_p(entry["p_holm"])
        interval = format_interval(entry["ci95"], 100, 2, "+")
        agreement = f"{entry['agreement']:.1%}" if "agreement" in entry else ""
        pair = titles[entry["a"]], titles[entry["b"]], entry["split"]
        rows.append([*pair, f"{100 * entry['mean']:+.2f}", interval, p, agreement])
    heads = ["this row", "against", "splits", "points", "95 % interval", "p, Holm", "agreement"]
    return [heads, *rows]
