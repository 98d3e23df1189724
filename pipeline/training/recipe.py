"""How a network on events is trained, and what it reads, by rules on the recordings.

For handwriting on the skin the defaults of the settings are the recipe.  They were chosen on
thousands of recordings of ten classes, whose events are few.  For all other recordings
:func:`recipe_for` chooses what suits their number, their classes and their events, as it was
cross-validated within the training parts of two sets of real recordings of touch: objects in a
robot's hand and Braille letters.
"""

from __future__ import annotations

import math

UPDATES = 1440
"""Minimum number of updates of the weights in a training on events."""

UPDATES_BY_ROOT = 60
"""Updates by the square root of the number of training samples."""

HANDWRITING_EPOCHS = 80
"""Minimum number of passes over the training samples for handwriting."""


def epochs_for(samples: int, batch_size: int, handwriting: bool) -> int:
    """Number of passes over the training samples, which has a suitable number of updates.

    Parameters
    ----------
    samples : int
        Number of training samples.
    batch_size : int
        Samples per update.
    handwriting : bool
        True for handwriting on the skin.
    """
    batches = -(-max(samples, 1) // batch_size)
    updates = max(UPDATES, UPDATES_BY_ROOT * math.sqrt(samples))
    return max(round(updates / batches), HANDWRITING_EPOCHS if handwriting else 1)
