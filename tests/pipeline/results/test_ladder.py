import re
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.results import read_result
from deploy.errors import UserError
from deploy.network.presentation import Presentation
from pipeline.kinds.reference import make_responses_of_logits
from pipeline.results.ladder import (
    find_losing_stages,
    format_ladder,
    format_points,
    make_ladder,
    make_rows,
)
from tests.command import call, missing
from tests.deploy.results import make_result

LABELS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]


def result(target, predictions, **changes):
    return make_result(predictions, LABELS, target=target, accuracy_ci95=[0.1, 0.9], **changes)


CNN = result("cnn", [0, 1, 2, 3, 4, 5, 6, 7, 8, 0])  # 9 right
RATE = result("rate-lif", [0, 1, 2, 3, 4, 0, 0, 0, 8, 1])  # 6 right, 4 differ, 3 of them lost
EMULATOR = result("emulator", [0, 1, 2, 3, 4, 5, 0, 0, 8, 1])  # 7 right, 1 differs, won


def test_the_ladder_by_hand():
    first, second, third = make_rows([CNN, RATE, EMULATOR])
    assert (first.stage, first.accuracy) == ("cnn", 0.9)
    assert (first.change, first.disagreements, first.mcnemar_p) == (None, None, None)
    assert second.change == pytest.approx(-0.3)
    assert second.disagreements == 4
    assert second.mcnemar_p == pytest.approx(2 * 0.5**3)
    assert third.change == pytest.approx(0.1)
    assert third.disagreements == 1
    assert third.mcnemar_p == 1


def test_a_loss_is_negative():
    text = format_ladder(make_ladder([RATE, EMULATOR]))
    assert missing(text.splitlines()[-1], "rate-lif", "emulator", "+10.0 points") == []
    assert format_points(-0.04) == "+0.0 points"
    assert format_points(-0.5) == "-0.5 points"


def test_results_of_different_bundles_make_no_ladder():
    with pytest.raises(UserError, match=r"b{12}.*c{12}"):
        make_rows([CNN, result("nengo", LABELS, bundle_id="c" * 64)])


def layer(name, correlation):
    shares = {"silent": 0.25, "saturated": 0.0}
    errors = {"worst_error": 0.5, "mean_error": 0.01}
    both = {"chip": shares, "rate_network": shares}
    return {"layer": name, "correlation": correlation, **errors, **both}


LAYERS = [layer("conv1", 0.99), layer("conv2", 0.87), layer("conv3", 0.95)]


def beyond_chance(ladder):
    """As if there were many samples more of the same."""
    first, *others = ladder.rows
    rows = [first, *(replace(row, mcnemar_p=0.01) for row in others)]
    return replace(ladder, rows=rows, last_against_trained_p=0.01)


def test_a_loss_that_chance_explains_is_no_warning():
    ladder = make_ladder([CNN, result("rate-lif", LABELS), EMULATOR], LAYERS)
    assert ladder.last_against_trained_p == pytest.approx(0.25)
    assert find_losing_stages(ladder) == []
    assert "loses" not in format_ladder(ladder)


def test_a_stage_that_loses_too_much_brings_the_layers():
    better = result("rate-lif", LABELS)
    ladder = beyond_chance(make_ladder([CNN, better, EMULATOR], LAYERS))
    assert ladder.least_faithful_layer == "conv2"
    assert find_losing_stages(ladder) == [("rate-lif", "emulator", pytest.approx(30))]
    text = format_ladder(ladder)
    assert re.search(r"emulator .*\b30\.0 points .*rate-lif", text)
    assert re.search(r"conv2 +0\.8700 +0\.500 +0\.0100", text)


def test_losses_are_stated_against_the_matched_cnn():
    """The paper's CNN, trained less, is no measure of what conversion costs."""
    cnn, matched, last = (
        of_eighty("cnn", 60),
        of_eighty("cnn-matched", 72),
        of_eighty("emulator", 70),
    )
    text = format_ladder(make_ladder([of_eighty("counts", 50), cnn, matched, last]))
    assert "from cnn-matched to emulator: -2.5 points" in text
    assert "from counts to emulator: +25.0 points" in text


def test_what_the_cnn_loses_is_no_matter_of_firing_rates():
    assert find_losing_stages(make_ladder([CNN, RATE])) == []


def of_eighty(target, right):
    """A result with the first samples right."""
    return make_result([1] * right + [0] * (80 - right), [1] * 80, target=target)


def test_the_deployed_network_is_compared_with_the_simplest_classifier():
    cnn, worse, better = of_eighty("cnn", 70), of_eighty("emulator", 54), of_eighty("emulator", 70)
    ladder = make_ladder([of_eighty("counts", 60), cnn, worse])
    assert ladder.against_counts.difference == pytest.approx(-6 / 80)
    assert ladder.against_counts.mcnemar_p == pytest.approx(2 * 0.5**6)
    lines = format_ladder(ladder).splitlines()
    assert missing(lines[-1], "emulator", "event counts", "try") == []
    assert any("from cnn to emulator: -20.0 points" in line for line in lines)
    text = format_ladder(make_ladder([of_eighty("counts", 60), cnn, better]))
    assert "try" not in text
    assert "from counts to emulator: +12.5 points" in text
    chance = make_ladder([of_eighty("counts", 58), cnn, worse])
    assert "try" not in format_ladder(chance)  # four samples are no evidence
    assert make_ladder([cnn, worse]).against_counts is None


def test_the_emulators_answers_are_the_fast_targets(tiny_run, tmp_path):
    """The samples of the check, on both."""
    out = tmp_path / "fast.json"
    assert call("check", "run", tiny_run / "bundle", "--target", "fast", "--out", out) == 0
    fast, emulator = read_result(out), read_result(tiny_run / "checks" / "emulator.json")
    assert fast["spikes"] == emulator["spikes"]
    for a, b in zip(fast["samples"], emulator["samples"], strict=True):
        # The host adds the same spikes in another order: the last bits of a score differ.
        np.testing.assert_allclose(a["scores"], b["scores"], rtol=0, atol=1e-9)
        assert (a["id"], a["prediction"]) == (b["id"], b["prediction"])


def test_scores_are_means_from_the_readouts_start():
    logits = np.array([[[9.0, 0.0], [0.0, 1.0], [4.0, 0.0], [0.0, 9.0]]])
    responses = make_responses_of_logits(logits, Presentation(steps=4, readout_start=1))
    assert responses.decisions.tolist() == [[-1, 1, 0, 1]]
    np.testing.assert_allclose(responses.scores, [[4 / 3, 10 / 3]])
    still = make_responses_of_logits(logits[:, :1], Presentation(steps=4, readout_start=1))
    assert still.predictions.tolist() == [0]
