"""How long, in which batches, and at which learning rate networks on images are trained."""

from __future__ import annotations

from dataclasses import dataclass, replace

from deploy.arithmetic import divide_up


@dataclass(frozen=True)
class TrainingSchedule:
    """How long a network is trained, and with which optimiser.

    Attributes
    ----------
    epochs, batch_size : int
    learning_rate : float
        Initial learning rate.
    annealed : bool
        Use Adam with a learning rate that falls to 0 along a half cosine; else RMSProp with a
        constant one (paper, Section 3.2).
    min_shown_samples : int
        Minimum number of samples shown in all epochs: a small data set gets more epochs.
    """

    epochs: int
    batch_size: int
    learning_rate: float
    annealed: bool = False
    min_shown_samples: int = 0

    def count_batches(self, n_samples: int) -> int:
        """Number of updates in an epoch."""
        return divide_up(n_samples, self.batch_size)

    def apply_settings(self, section, n_samples: int) -> TrainingSchedule:
        """This schedule with the values of a section of the settings that are not 0.

        The default number of epochs is the schedule's, or more for a small data set.

        Parameters
        ----------
        section : pipeline.settings.groups.CNN or pipeline.settings.groups.SNN
        n_samples : int
            Number of training samples.
        """
        return replace(
            self,
            epochs=section.epochs or max(self.epochs, divide_up(self.min_shown_samples, n_samples)),
            batch_size=section.batch_size or self.batch_size,
            learning_rate=section.learning_rate or self.learning_rate,
        )


# Defaults of each ``snn.recipe``, where a setting is 0; the CNN has the paper's.
SCHEDULES = {
    # The paper's 20 epochs of ST-MNIST show 111,240 samples.
    "paper": TrainingSchedule(
        epochs=20, batch_size=8, learning_rate=0.001, min_shown_samples=80_000
    ),
    "loihi": TrainingSchedule(
        epochs=60,
        batch_size=64,
        learning_rate=0.004,
        annealed=True,
        min_shown_samples=160_000,
    ),
    "as-is": TrainingSchedule(epochs=0, batch_size=0, learning_rate=0.0),
}


def make_cnn_schedule(cnn, n_samples: int) -> TrainingSchedule:
    """The paper's schedule for the CNN, with changes from the settings."""
    return SCHEDULES["paper"].apply_settings(cnn, n_samples)


def make_snn_schedule(snn, n_samples: int) -> TrainingSchedule:
    """The schedule of ``snn.recipe`` for the rate-based network, with changes from the settings."""
    schedule = SCHEDULES[snn.recipe]
    return schedule if snn.recipe == "as-is" else schedule.apply_settings(snn, n_samples)
