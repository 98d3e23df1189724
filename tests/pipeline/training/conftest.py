"""What tests of training share."""

import pytest


@pytest.fixture
def run_of(monkeypatch):
    """``run_of(module, train)``: of which run the checkpoint of a training is.

    ``train`` is called and stopped where it would begin: what follows takes seconds.
    """

    def told(module, train):
        runs = []

        def keep(train, epochs, state, checkpoint, *rest):
            runs.append(checkpoint.key)
            raise InterruptedError

        monkeypatch.setattr(module, "train_epochs", keep)
        with pytest.raises(InterruptedError):
            train()
        return runs[0]

    return told
