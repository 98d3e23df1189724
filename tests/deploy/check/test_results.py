"""Reading results and comparing them, here and through both command lines."""

import json

import pytest

from deploy.check.comparison import compare_results, describe_loss
from deploy.check.results import (
    CheckResult,
    EarlyDecisions,
    SubsetAccuracy,
    WhileWritten,
    read_result,
    write_result,
)
from deploy.errors import UserError
from deploy.files import write_json
from tests.command import call, missing
from tests.deploy.results import make_result


def test_a_comparison_by_hand():
    comparison = compare_results(make_result(), make_result((0, 2, 2, 1), target="emulator"))
    assert comparison.targets == ("nengo", "emulator")
    assert comparison.accuracy_drop == pytest.approx(0.5)
    assert comparison.p_value == pytest.approx(0.5)  # both lost: 2 * 0.5**2
    assert comparison.disagreements == [
        {"id": "x/1", "label": 1, "a": 1, "b": 2},
        {"id": "x/3", "label": 3, "a": 3, "b": 1},
    ]
    plain = comparison.to_json()
    assert plain["n_disagreements"] == 2
    assert json.loads(json.dumps(plain)) == plain


def test_two_wrong_answers_disagree_without_a_drop():
    comparison = compare_results(make_result((5, 1, 2, 3)), make_result((6, 1, 2, 3)))
    assert len(comparison.disagreements) == 1
    assert comparison.accuracy_drop == 0
    assert comparison.p_value == 1


@pytest.mark.parametrize(
    ("other", "fact"),
    [
        (make_result(bundle_id="c" * 64), "b{12}.*c{12}"),
        (make_result((0, 1, 2), (0, 1, 2)), "samples"),
        (make_result(labels=(0, 1, 2, 4)), "samples"),
    ],
)
def test_what_cannot_be_compared(other, fact):
    with pytest.raises(UserError, match=fact):
        compare_results(make_result(), other)


@pytest.mark.parametrize(
    "change",
    [
        {"schema": "stmnist-check/2"},
        {"schema": None},
        {"accuracy": 0.5},
        {"accuracy": "high"},
        {"accuracy_ci95": None},
        {"accuracy_ci95": [0.1]},
        {"n_samples": 5},
        {"samples": []},
        {"samples": {}},
        {"samples": [1, 2, 3, 4]},
        {"samples": [{"id": "x", "label": 0, "prediction": 0}] * 4},
        {"bundle": None},
    ],
)
def test_a_file_that_is_no_whole_result_is_named_with_the_remedy(tmp_path, change):
    write_json(tmp_path / "a.json", {**make_result().to_dict(), **change})
    with pytest.raises(UserError, match=r"a\.json: .*run the check"):
        read_result(tmp_path / "a.json")


@pytest.fixture
def pair(tmp_path):
    """B differs in two samples of which it lost one."""
    write_result(tmp_path / "a.json", make_result((0, 1, 2, 9)))
    write_result(tmp_path / "b.json", make_result((0, 7, 2, 8), target="emulator"))
    return tmp_path / "a.json", tmp_path / "b.json"


@pytest.mark.parametrize(
    ("options", "status", "facts"),
    [
        ([], 0, []),
        (["--max-disagreements", 2], 0, []),
        (["--max-disagreements", 1], 1, [2, 1]),
        (["--max-accuracy-drop", 0.25], 0, []),
        (["--max-accuracy-drop", 0.2], 1, ["0.2500", " 0.2 "]),
        (["--max-disagreements", "few"], 2, ["--max-disagreements"]),
        (["--max-disagreements", -1], 2, ["--max-disagreements", 0]),
        *(
            ([f"--max-accuracy-drop={limit}"], 2, ["--max-accuracy-drop", "equal to"])
            for limit in ("nan", "inf", "-inf", "1.5", "-0.1")
        ),
    ],
)
def test_limits_and_exit_status(pair, capsys, options, status, facts):
    assert call("check", "compare", *pair, *options) == status
    out, err = capsys.readouterr()
    assert missing(err, *facts) == []
    if status < 2:
        assert missing(out, "2 of 4", "x/1") == []


def test_the_comparison_for_a_program(pair, capsys):
    assert call("check", "compare", *pair, "--json") == 0
    assert json.loads(capsys.readouterr().out)["n_disagreements"] == 2


def test_a_loss_that_is_no_chance_is_said():
    many = tuple(range(10)) * 4
    trained = make_result(many, many, target="cnn")
    assert describe_loss(trained, make_result(many, many, target="fast")) is None
    assert describe_loss(trained, make_result((1, *many[1:]), many, target="fast")) is None
    line = describe_loss(trained, make_result((0,) * 40, many, target="fast"))
    assert missing(line, "fast", "cnn", "0.100", "1.000", "McNemar") == []


def test_a_result_is_the_same_after_its_plain_values():
    early = EarlyDecisions(0.9, 0.75, [0.4, 0.9], share_of_writing_mean=0.8, before_the_end=0.5)
    result = make_result(
        while_written=WhileWritten(10.0, 50.0, [1.0], [0.75], early),
        target_notes={"hardware": {"board": "ncl"}},
        per_class=[SubsetAccuracy(4, 1.0, [0.5, 1.0], class_name="7")],
    )
    values = json.loads(json.dumps(result.to_dict()))
    assert values["while_written"]["by_itself"]["confidence"] == 0.9
    assert values["per_class"][0]["class"] == "7"
    assert values["hardware"] == {"board": "ncl"}
    assert not {"data", "target_notes"} & set(values)
    assert CheckResult.from_dict(values) == result
    assert compare_results(values, result).accuracy_drop == 0
    assert result["hardware"] == {"board": "ncl"}
