"""What an interruption leaves, and which training takes it up."""

import pytest

from deploy.errors import UserError
from models.keras.keras2 import tf
from pipeline.training.events import Checkpoint, train_epochs


class Training:
    """Adds the number of the epoch to all that there is so far, twice over."""

    def __init__(self):
        self.state = {"sum": tf.Variable([1.0, 2.0])}
        self.trained, self.told = [], []

    def epoch(self, epoch):
        self.trained.append(epoch)
        self.state["sum"].assign(2 * self.state["sum"] + epoch)
        return {"loss": float(self.state["sum"][0]), "accuracy": 0.5}

    def run(self, path, epochs=4, run="this one", stop_after=None):
        def advance(n, note):
            self.told.append((n, note))
            if len(self.trained) == stop_after:
                raise KeyboardInterrupt

        checkpoint = None if path is None else Checkpoint(path, run)
        return train_epochs(self.epoch, epochs, self.state, checkpoint, advance=advance)


@pytest.fixture(scope="module")
def whole():
    training = Training()
    return training, training.run(None)


def without_time(history):
    return [{key: value for key, value in row.items() if key != "seconds"} for row in history]


def test_an_interrupted_training_ends_as_it_would_have(whole, tmp_path):
    path = tmp_path / "state.npz"
    with pytest.raises(KeyboardInterrupt):
        Training().run(path, stop_after=3)
    again = Training()
    history = again.run(path)
    assert again.trained == [3]
    assert again.told == [(3, "accuracy 0.500"), (1, "accuracy 0.500")]
    assert without_time(history) == without_time(whole[1])
    assert again.state["sum"].numpy().tolist() == whole[0].state["sum"].numpy().tolist()


def test_what_is_finished_is_not_trained_or_saved_again(tmp_path):
    path = tmp_path / "state.npz"
    Training().run(path)
    before, again = path.read_bytes(), Training()
    assert len(again.run(path)) == 4
    assert again.trained == []
    assert path.read_bytes() == before


def test_more_epochs_go_on_from_it_and_fewer_start_afresh(whole, tmp_path):
    path = tmp_path / "state.npz"
    Training().run(path, epochs=2)
    longer, shorter = Training(), Training()
    assert without_time(longer.run(path)) == without_time(whole[1])
    assert longer.trained == [2, 3]
    assert without_time(shorter.run(path, epochs=3)) == without_time(whole[1])[:3]
    assert shorter.trained == [0, 1, 2]


def test_a_checkpoint_of_another_run_is_not_taken_up(whole, tmp_path):
    path = tmp_path / "state.npz"
    Training().run(path, run="another")
    training = Training()
    assert without_time(training.run(path)) == without_time(whole[1])
    assert training.trained == [0, 1, 2, 3]
    again = Training()
    again.run(path)  # it has left its own in the place of the other's
    assert again.trained == []


def test_a_damaged_checkpoint_is_named(tmp_path):
    path = tmp_path / "state.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(UserError, match=r"state\.npz"):
        Training().run(path)
