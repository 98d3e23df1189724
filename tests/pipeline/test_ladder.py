import pytest

from deploy.errors import UserError
from pipeline.ladder import climb, ladder_json, ladder_text

LABELS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]


def result(target, predictions, bundle="b" * 64):
    right = sum(p == label for p, label in zip(predictions, LABELS, strict=True))
    return {
        "target": target,
        "bundle": bundle,
        "simulated": True,
        "n_samples": 10,
        "accuracy": right / 10,
        "accuracy_ci95": [0.1, 0.9],
        "samples": [
            {"id": str(i), "label": label, "prediction": p}
            for i, (label, p) in enumerate(zip(LABELS, predictions, strict=True))
        ],
    }


CNN = result("cnn", [0, 1, 2, 3, 4, 5, 6, 7, 8, 0])  # 9 right
RATE = result("rate-lif", [0, 1, 2, 3, 4, 0, 0, 0, 8, 1])  # 6 right, 4 differ, 3 of them lost
EMULATOR = result("emulator", [0, 1, 2, 3, 4, 5, 0, 0, 8, 1])  # 7 right, 1 differs, won


def test_the_ladder_by_hand():
    first, second, third = climb([CNN, RATE, EMULATOR])
    assert (first.stage, first.accuracy) == ("cnn", 0.9)
    assert (first.drop, first.disagreements, first.mcnemar_p) == (None, None, None)
    assert second.drop == pytest.approx(0.3)
    assert second.disagreements == 4
    assert second.mcnemar_p == pytest.approx(2 * 0.5**3)
    assert third.drop == pytest.approx(-0.1)
    assert third.disagreements == 1
    assert third.mcnemar_p == 1


def test_the_table():
    text = ladder_text(ladder_json([CNN, RATE, EMULATOR]))
    assert text.splitlines() == [
        "Loss ladder, 10 simulated samples, each stage on the same ones",
        "stage        accuracy  95 % interval     drop  disagree",
        "cnn             0.900  0.100 to 0.900",
        "rate-lif        0.600  0.100 to 0.900  +0.300         4",
        "emulator        0.700  0.100 to 0.900  -0.100         1",
        "from cnn to emulator: 20.0 points lost",
    ]


def test_only_simulated_samples_are_called_so():
    text = ladder_text(ladder_json([{**CNN, "simulated": False}]))
    assert "simulated" not in text


def test_results_of_different_bundles_make_no_ladder():
    with pytest.raises(UserError, match="different bundles"):
        climb([CNN, result("nengo", LABELS, bundle="c" * 64)])
