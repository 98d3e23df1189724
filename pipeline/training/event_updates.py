"""How long a network on events is trained: updates, passes over the samples, steps of a sample."""

import math

from deploy.arithmetic import divide_up

# Number of steps after a sample's last event in which its spikes still reach the outputs.
TAIL_STEPS = 3

# Minimum number of updates of the weights in a training on events.
MIN_UPDATES = 1440

# Updates by the square root of the number of training samples.
UPDATES_BY_ROOT_OF_SAMPLES = 60

# Minimum number of passes over the training samples, unless these take more updates than that.
MIN_EPOCHS = 40
MAX_UPDATES_OF_MIN_EPOCHS = 8000


def choose_epochs(n_samples: int, batch_size: int) -> int:
    """Number of passes over the training samples, which has a suitable number of updates.

    Parameters
    ----------
    n_samples : int
        Number of training samples.
    batch_size : int
        Number of samples of an update.
    """
    batches = divide_up(max(n_samples, 1), batch_size)
    updates = max(MIN_UPDATES, UPDATES_BY_ROOT_OF_SAMPLES * math.sqrt(n_samples))
    fewest = min(MIN_EPOCHS, MAX_UPDATES_OF_MIN_EPOCHS // batches)
    return max(round(updates / batches), fewest, 1)
