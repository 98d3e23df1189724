"""The tables of an experiment's result as text."""

from deploy.tables import align_rows
from experiments import tables
from experiments.catalogue import Experiment

# Accuracy of each model over the splits, mean and SD (Table 2).
TABLE2 = {
    "cnn": (0.89, 0.01),
    "ann-snn": (0.87, 0.01),
    "loihi": (0.86, 0.02),
    "slayer": (0.81, 0.01),
}

# Costs in a table, and their formats; the last two are the share of a recording until the early
# decision and its accuracy.
COSTS = (
    *(("per_cnn", "{:.2f}"), ("per_dense", "{:.2f}"), ("updates", "{:,.0f}")),
    *(("share", "{:.0%}"), ("early", "{:.3f}")),
)


def make_cells(experiment: Experiment, result: dict, split: str) -> list:
    """The rows of a table as lists of text, the heads first; the paper's only on random splits."""
    titles = {line.name: line.title for line in experiment.lines}
    has_papers_column = experiment.name == "table2" and split == "random"
    decides_early = any("share" in row.get("costs", {}) for row in result["rows"])
    heads = ["accuracy (SD)", "95 % interval", "splits", "operations / CNN", "/ dense"]
    heads += ["neuron updates"]
    heads += ["early after", "early accuracy"] if decides_early else []
    lines = [
        [f"network, {split} splits", *heads, *(["paper, real data"] if has_papers_column else [])]
    ]
    for row in result["rows"]:
        if row["split"] != split:
            continue
        sd = "" if row["sd"] is None else f" ({row['sd']:.3f})"
        interval = tables.format_interval([min(max(b, 0.0), 1.0) for b in row["ci95"] or ()])
        line = [titles[row["name"]], f"{row['mean']:.3f}{sd}", interval, str(len(row["seeds"]))]
        costs = row.get("costs", {})
        columns = COSTS if decides_early else COSTS[:3]
        line += [layout.format(costs[name]) if name in costs else "" for name, layout in columns]
        if has_papers_column:
            published = TABLE2.get(row["name"])
            line.append("{:.2f} ({:.2f})".format(*published) if published else "")
        lines.append(line)
    return lines


def format_result(experiment: Experiment, result: dict) -> str:
    """A result as tables."""
    recordings = "simulated recordings" if result["simulated"] else "recordings"
    lines = [f"{experiment.title}, on {recordings}: means over splits"]
    for split in dict.fromkeys(row["split"] for row in result["rows"]):
        lines += ["", *align_rows(make_cells(experiment, result, split))]
        if any(len(row["seeds"]) == 1 for row in result["rows"]):
            lines.append("the intervals of a single split are Wilson's, over its test samples")
        elif split == "published":
            lines.append("the intervals are over trainings on this one split")
    if result["comparisons"]:
        titles = {line.name: line.title for line in experiment.lines}
        lines += ["", *align_rows(tables.make_comparison_cells(result, titles))]
    lines += ["", experiment.note]
    lines.append(
        "operations: synaptic, readout included, relative to the multiply-accumulates of the "
        "paper's CNN and of the dense form of the network itself; updates: per inference"
    )
    return "\n".join(lines)
