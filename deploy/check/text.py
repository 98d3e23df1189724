"""Format a result, or the comparison of two, as a few lines."""

from __future__ import annotations

from ..tables import align_rows, list_names
from ..terminal import WARNING, escape_control
from .comparison import Comparison
from .results import CheckResult


def format_result(result: CheckResult) -> str:
    """Format a check result as a few lines."""
    low, high = result.accuracy_ci95
    n_samples = result.n_samples
    simulated = "simulated " if result.simulated else ""
    spikes = ", ".join(
        f"{escape_control(name)} {count / n_samples:.0f}" for name, count in result.spikes.items()
    )
    operations = sum(result.synaptic_operations.values()) / n_samples
    macs = sum(result.multiply_accumulates.values())
    absent = describe_absent_classes(result.classes_without_samples)
    text = (
        f"{escape_control(result.target)}: "
        f"accuracy {result.accuracy:.3f} (95 % interval {low:.3f} to "
        f"{high:.3f}) on {n_samples} {simulated}samples of "
        f"{result.steps_per_sample} steps\nspikes a sample: {spikes}\n"
        f"synaptic operations a sample: {operations:.0f}, {operations / macs:.2f} times the "
        f"{macs} multiply-accumulates of a CNN of this architecture\n"
        f"{result.wall_seconds:.1f} s, {n_samples / result.wall_seconds:.1f} "
        "samples a second" + _describe_hardware(result)
    )
    return f"{text}\n{absent}" if absent else text


def describe_absent_classes(names) -> str:
    """The warning that names the classes without samples; empty if there are none."""
    if not names:
        return ""
    return (
        f"{WARNING}classes without samples: {list_names(names)}; the accuracies do not cover them"
    )


def format_result_on_others(result: CheckResult) -> str:
    """Format a result on other recordings: :func:`format_result`, classes and writers."""
    data = result.data
    classes = result.classes
    assert data is not None
    assert classes is not None
    short = {name: name if len(name) <= 40 else name[:26] + "…" + name[-13:] for name in classes}
    lines = [f"on {result.n_samples} of {data.recordings} recordings in {data.source}"]
    if data.trained_on:
        lines.append(f"{data.trained_on} of them were used to make the network")
    lines.append(format_result(result))
    for head, subsets in (("class", result.per_class), ("writer", result.per_writer)):
        if subsets:
            lines += align_rows(
                [
                    [head, "n", "accuracy", "95 % interval"],
                    *(_make_subset_cells(subset, short) for subset in subsets),
                ]
            )
    wrong = [
        (count, classes[label], classes[prediction])
        for label, counts in enumerate(result.confusion or ())
        for prediction, count in enumerate(counts)
        if label != prediction and count
    ]
    for count, label, prediction in sorted(wrong, key=lambda entry: -entry[0])[:5]:
        lines.append(f"{short[label]} classified as {short[prediction]}: {count}")
    return "\n".join(lines)


def _make_subset_cells(subset, short):
    """The row of a class or writer in the table of accuracies."""
    low, high = subset.accuracy_ci95
    name = str(subset.writer) if subset.class_name is None else short[subset.class_name]
    return [name, str(subset.n), f"{subset.accuracy:.3f}", f"{low:.3f} to {high:.3f}"]


def _describe_hardware(result):
    """Lines about a board."""
    notes = result.target_notes
    if "hardware" not in notes:
        return ""
    board = notes["hardware"]
    timing = notes["timing"]
    phases = ", ".join(
        f"{phase} {timing[f'{phase}_seconds_per_sample']:.3f} s"
        for phase in ("build", "connect", "run")
    )
    text = (
        f"\nboard {_join_named(board['board'], 'of the cluster')}, "
        f"partition {_join_named(board['partition'], 'none')}, "
        f"NxSDK {result.versions['nxsdk']}, {board['connections']} connections; "
        f"per sample: {phases}"
    )
    unlike = result.samples_unlike_fast  # None without Numba
    if unlike:
        text += (
            f"\nspikes of {unlike} samples differ from those of the target fast: some were lost, "
            "or the board computes differently"
        )
    elif unlike == 0:
        text += "\nall spikes are identical to those of the target fast"
    if "power" in notes:
        power = notes["power"]
        text += (
            f"\nmeasured power: {power['dynamic_mw']:.3g} mW, in addition to "
            f"{power['static_mw']:.3g} mW when idle, {power['step_microseconds']:.3g} us a step"
        )
    return text


def _join_named(named, without_name):
    """A name, or all of a list of names."""
    names = named if isinstance(named, list) else [named]
    return " and ".join(name or without_name for name in names)


def format_comparison(comparison: Comparison) -> str:
    """Format a comparison as a few lines, with the first ten samples that differ."""
    (a, b) = map(escape_control, comparison.targets)
    differ = comparison.disagreements
    lines = [
        f"{a} {comparison.accuracies[0]:.3f}, {b} {comparison.accuracies[1]:.3f}, "
        f"drop {comparison.accuracy_drop:+.3f}",
        f"{len(differ)} of {comparison.n_samples} predictions differ "
        f"({len(differ) / comparison.n_samples:.1%}); McNemar p = {comparison.p_value:.3g}",
    ]
    if comparison.other_spikes == 0:
        lines.append("every spike of every sample is the same")
    elif comparison.other_spikes is not None:
        lines.append(f"spikes differ in {comparison.other_spikes} samples")
    if differ:
        rows = []
        for sample in differ[:10]:
            rows.append([sample["id"], str(sample["label"]), str(sample["a"]), str(sample["b"])])
        lines += align_rows([["sample", "label", a, b], *rows])
    if len(differ) > 10:
        lines.append(f"and {len(differ) - 10} more")
    return "\n".join(lines)
