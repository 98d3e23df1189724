from pipeline.kinds.records import read_history, write_history


def test_a_history_is_read_back(tmp_path):
    history = [
        {"epoch": 1, "loss": 2.5, "accuracy": 0.1 + 0.2},
        {"epoch": 2, "loss": 1e-9, "accuracy": 1},
    ]
    write_history(tmp_path / "history.csv", history)
    assert read_history(tmp_path / "history.csv") == history
    assert (tmp_path / "history.csv").read_text().startswith("epoch,loss,accuracy\n1,2.5,")


def test_without_training_there_is_no_history_nor_one_from_before(tmp_path):
    write_history(tmp_path / "history.csv", [{"epoch": 1, "accuracy": 0.5}])
    write_history(tmp_path / "history.csv", [])
    assert not list(tmp_path.iterdir())
    write_history(tmp_path / "history.csv", [])
