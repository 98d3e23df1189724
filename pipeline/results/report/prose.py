"""Sentences of the report whose words depend on the results."""

from markupsafe import Markup, escape

from deploy.check.results import CheckResult
from deploy.tables import format_count, format_p
from deploy.targets.registry import TARGETS
from pipeline.kinds.registry import list_references
from pipeline.results.report.charts import format_percent

# Highest probability that is printed: none is certain.
MAX_PROBABILITY = 0.999


def format_points(change: float) -> str:
    """A difference of accuracies in points, with its sign, such as ``"−0.5"``."""
    return f"{100 * change + 0.0:+.1f}".replace("-", "−")


def format_p_value(p: float) -> Markup:
    """The p value of a test, such as ``"p = 0.03"`` or ``"p < 0.001"``, without a line break."""
    sign = "=&nbsp;" if p >= 0.001 else ""
    return Markup(f"p&nbsp;{sign}") + escape(format_p(p).replace(" ", "\u00a0"))


def format_interval(bounds) -> str:
    """A 95 % interval in percent."""
    low, high = bounds
    return f"{format_percent(low)} to {format_percent(high)}"


def find_stage_note(stage: str) -> str:
    """What a stage of the ladder is, in a few words."""
    row = list_references().get(stage) or TARGETS[stage]
    return row.note or row.title


def describe_verdict(verdict: dict, result: CheckResult, plan: dict, simulated: bool) -> Markup:
    """The accuracy of the deployed network, compared with its references."""
    samples = "simulated test samples" if simulated else "test samples"
    accuracy = format_percent(result.accuracy)
    sentences = [
        escape(f"{verdict['title']}: {accuracy} of {result.n_samples:,} {samples} are right.")
    ]
    for other in verdict["against"]:
        difference = "no significant difference"
        if other["significant"]:
            difference = f"significantly {'less' if other['change'] > 0 else 'more'}"
        begin = f"{other['title']}: {format_percent(other['accuracy'])}, {difference} ("
        sentences.append(escape(begin) + format_p_value(other["p"]) + ").")
    if not plan["fits"]:
        sentences.append(Markup("It does not fit on the chip."))
    return Markup(" ").join(sentences)


def describe_losses(verdict: dict) -> Markup:
    """The loss from each reference to the deployed network."""
    return Markup(" ").join(
        escape(
            f"From “{other['title']}” to “{verdict['title']}”: "
            f"{format_points(other['change'])} points, "
        )
        + format_p_value(other["p"])
        + "."
        for other in verdict["against"]
    )


def describe_ladder(ladder: dict) -> str:
    """What the rows and columns of the ladder are."""
    baseline = ""
    if ladder["rows"][0]["stage"] == "counts":
        baseline = f" {ladder['rows'][0]['title']} is the simplest baseline."
    return f"Each stage predicts the same {ladder['n']:,} test samples.{baseline}"


def describe_stories(groups: list, stories: list, time: dict | None, has_estimator: bool) -> str:
    """Which samples are shown over time, and what their panels are."""
    n_wrong = sum(len(group["samples"]) for group in groups if not group["right"])
    n_shown = sum(not story["right"] for story in stories)
    sentences = []
    if n_wrong:
        mistakes = format_count(n_wrong, "mistake")
        which = f"{n_shown} of the {mistakes}" if n_shown < n_wrong else mistakes.capitalize()
        sentences.append(f"{which}, then correct predictions.")
    colours = " (ON blue, OFF orange)" if time and time["on_events"] else ""
    outputs = "the softmax of the outputs, which only suggests probabilities"
    if has_estimator:
        outputs = "the probabilities of the most likely classes, estimated at each step"
    early = "; the network decides when one reaches the dotted line"
    sentences += [
        "“Correct” or “wrong” is the prediction at the end.",
        "All panels of a sample have the same time axis: the spikes of the input"
        f"{colours} and of each layer on the emulated chip, and {outputs}"
        f"{early if time and time['early'] else ''}.",
    ]
    return " ".join(sentences)


def describe_story(story: dict, n_classes: int) -> str:
    """A sample's name, its probability at the end, and its early decision."""
    chance = "no better than a guess"
    if story["probability"] * n_classes >= 1.01:
        chance = format_percent(min(story["probability"], MAX_PROBABILITY))
    text = f"{story['id']}, {chance} at the end"
    if not story["early"]:
        return text
    at_ms, prediction, probability = story["early"]
    is_right = "correct" if prediction == story["shown"] else "wrong"
    return (
        f"{text}; early decision after {at_ms:.0f} ms (line): {prediction}, {is_right}, "
        f"{format_percent(min(probability, MAX_PROBABILITY))}"
    )


def describe_time(time: dict, accuracy: float) -> str:
    """How accurate early decisions are, and what half of a recording tells."""
    sentences = []
    early = time["early"]
    if early:
        share = format_percent(early.share_of_writing_mean)
        sentences.append(
            f"{time['name']} decides early when its confidence reaches "
            f"{format_percent(early.confidence)}: after {share} of "
            f"the recording on average, {format_percent(early.accuracy)} right "
            f"({format_interval(early.accuracy_ci95)})."
        )
    if time["half"] is not None:
        whole = "recording" if time["on_events"] else "presentation"
        half = format_percent(time["half"])
        sentences.append(
            f"If the predictions were read after half of the {whole}, {half} would "
            f"be correct; at the end of the presentation {format_percent(accuracy)} are."
        )
    if time["on_events"]:
        sentences.append(
            "The axis ends at the last event (100 %); some spikes reach the output after it, so "
            "that the accuracy at the end of the presentation can be another."
        )
    else:
        sentences.append("An image is presented when its recording has ended.")
    return " ".join(sentences)


def describe_time_axis(time: dict, has_counts: bool) -> str:
    """What the curve, the dots and the dashed line of accuracy over time are."""
    dots = "Dot: end of the presentation"
    if time["early"]:
        dots = "Dots: end of the presentation, and early decisions at their mean time"
    dashed = "; dashed: logistic regression on all event counts" if has_counts else ""
    return (
        "Accuracy if the prediction were read at this time, with 95 % intervals (Wilson). "
        f"{dots}{dashed}."
    )


def describe_result_on_others(result: CheckResult) -> Markup:
    """The target, the interval and the warnings of a check on other recordings."""
    text = escape(f"{result.target}, {format_interval(result.accuracy_ci95)}")
    if result.simulated:
        text += "; simulated recordings"
    data = result.data
    assert data is not None
    warnings = list(data.warnings or ())
    if data.trained_on:
        warnings.insert(
            0,
            f"{data.trained_on} of these samples were used to make the network, and its "
            "accuracy on them says little about others",
        )
    for line in warnings:
        text += Markup("; <strong>{}</strong>").format(line)
    return text


def describe_energy(energy: dict) -> Markup:
    """The estimate of energy, and what it is made of."""
    return Markup(
        "Energy is an <strong>estimate</strong> from published energies per operation: "
        "{loihi} for one inference on Loihi, {share} of it for neuron updates (Davies et al. 2018, "
        "simulated circuits); {cpu} on a CPU and {gpu} on a GPU for the same network without "
        "spikes (Degnan et al. 2016). The readout counts as if it were on the chip. Idle power, "
        "the host, spikes to and from the chip and memory traffic are left out."
    ).format(
        loihi=energy["loihi"].replace("u", "µ"),
        share=format_percent(energy["share_of_updates"]),
        cpu=energy["cpu"].replace("u", "µ"),
        gpu=energy["gpu"].replace("u", "µ"),
    )
