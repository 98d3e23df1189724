import json

import pytest

from tools import figures
from tools.figures import figure, with_figures

NOW, BEFORE = "1" * 64, "2" * 64


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "FOLDER", tmp_path)
    monkeypatch.setattr(figures, "recordings_now", lambda: NOW)
    return tmp_path


def store(folder, name, sha256, model="cnn", splits=10):
    row = {
        "model": model,
        "accuracy_mean": 0.8912,
        "accuracy_sd": 0.0061 if splits > 1 else None,
        "per_split": [0.9] * splits,
    }
    table = {"source_sha256": sha256, "rows": [row], "writer_rows": []}
    (folder / f"{name}.json").write_text(json.dumps(table))


def row_of(title):
    (line,) = [line for line in figures.table2_markdown().splitlines() if f"| {title} |" in line]
    return [cell.strip() for cell in line.split("|")[2:-1]]


def test_a_figure_is_found_by_its_path(folder):
    store(folder, "table2-images", NOW)
    assert figure("table2-images rows cnn accuracy_mean .3f") == "0.891"
    assert figure("table2-images rows 0 accuracy_sd 100*.1f") == "0.6"
    text = "mean <!-- figure: table2-images rows cnn accuracy_mean .2f -->0.1<!-- /figure -->."
    assert ">0.89<" in with_figures(text)
    assert with_figures(with_figures(text)) == with_figures(text)


@pytest.mark.parametrize(
    "address",
    [
        "table2-images rows svm accuracy_mean .3f",
        "table2-images nothing .3f",
        "table2-images rows cnn model .3f",
        "no-such-result a .3f",
    ],
)
def test_a_figure_that_is_not_there_is_an_error(folder, address):
    store(folder, "table2-images", NOW)
    with pytest.raises(ValueError, match="figure"):
        figure(address)


def test_a_row_says_its_recordings_and_how_many_splits_there_are(folder):
    store(folder, "table2-images", NOW)
    store(folder, "table2-slayer-random", BEFORE, "slayer", splits=1)
    assert row_of("CNN") == ["0.891 (0.006)", "not measured", "0.89 (0.01)"]
    ours, _, paper = row_of("SNN-SLAYER")
    assert ours.startswith("0.891")
    assert "1 split" in ours
    assert figures.EARLIER in ours
    assert paper == "0.81 (0.01)"


def test_the_calibration_knows_the_built_in_recordings():
    assert len(figures.recordings_now()) == 64


@pytest.mark.parametrize("name", figures.TABLES)
def test_every_table_can_be_made_from_the_results(name):
    assert figures.TABLES[name]().strip()
