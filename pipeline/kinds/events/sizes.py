"""Sizes of networks on events, and their architectures, budgets and dropout."""

import math
from dataclasses import dataclass

from pipeline.kinds.architectures import EVENT_MAP, suggest_architecture
from pipeline.recordings.recordings import Recordings, is_handwriting
from pipeline.recordings.sensor import Sensor
from pipeline.settings import EventTraining

# Number of training samples below which there are few, and the dropout of spikes for few.
FEW_SAMPLES = 2000
FEW_DROPOUT = 0.5

# Neurons of the hidden layer of a standard network without convolution, for more classes than
# `MANY_CLASSES` and for fewer; and for few samples also with a convolution.
HIDDEN_FEW_SAMPLES = 256
HIDDEN_MANY_CLASSES = 128
HIDDEN = 64
MANY_CLASSES = 10

# Events per recording for which the budgets of the sizes hold; they grow with the events.
USUAL_EVENTS = 500


@dataclass(frozen=True)
class NetworkSize:
    """The capacity of a network on events.

    Attributes
    ----------
    name : str
        A value of ``events.size``.
    filters, stride, overlap : int
        Of the convolution; its kernel has ``stride + overlap`` rows and columns.  The stride is for
        ten rows and columns of taxels and grows with them.
    hidden : int
        Neurons of the hidden layer after the convolution.
    width : float
        Neurons of the hidden layer of other networks, in multiples of the standard size's.
    budget : float
        Synaptic operations of a recording of `USUAL_EVENTS`, in multiples of the CNN's.
    passes : int
        Passes over the training samples, in multiples of what
        :func:`pipeline.training.event_updates.choose_epochs` chooses.
    dropout : float
        Share of a layer's neurons whose spikes are left out, unless there are few samples.
    """

    name: str
    filters: int
    stride: int
    overlap: int
    hidden: int
    width: float
    budget: float
    passes: int = 1
    dropout: float = EventTraining.dropout

    def is_for(self, sensor: Sensor, n_samples: int) -> bool:
        """True if a sensor and a number of training samples suit its convolution."""
        return sensor.is_grid and n_samples >= FEW_SAMPLES


SIZES = {
    size.name: size
    for size in (
        NetworkSize("small", 24, 3, 1, hidden=64, width=0.5, budget=0.8),
        NetworkSize("standard", 32, 2, 2, hidden=128, width=1.0, budget=2.0),
        NetworkSize("large", 48, 2, 2, hidden=192, width=1.5, budget=3.5, passes=3, dropout=0.2),
    )
}


def choose_size(name: str, recordings: Recordings) -> NetworkSize:
    """The size of a network: ``auto`` is small for handwriting that is simulated, else standard.

    Parameters
    ----------
    name : str
        The value of ``events.size``.
    recordings : Recordings
    """
    if name != "auto":
        return SIZES[name]
    source = recordings.source
    is_easy = is_handwriting(recordings) and (source.simulated or source.written)
    return SIZES["small" if is_easy else "standard"]


def choose_hidden_units(size: NetworkSize, n_samples: int, n_classes: int) -> int:
    """Neurons of the hidden layer of a network that has few samples or no convolution."""
    hidden = HIDDEN_MANY_CLASSES if n_classes > MANY_CLASSES else HIDDEN
    if n_samples < FEW_SAMPLES:
        hidden = HIDDEN_FEW_SAMPLES
    return round(hidden * size.width)


def choose_dropout(size: NetworkSize, n_samples: int) -> float:
    """Dropout for touch that is not simulated handwriting."""
    return FEW_DROPOUT if n_samples < FEW_SAMPLES else size.dropout


def suggest_event_architecture(sensor: Sensor, size: NetworkSize, n_samples: int) -> str:
    """An architecture of a size for a network on events.

    Parameters
    ----------
    sensor : Sensor
    size : NetworkSize
    n_samples : int
        Number of training samples; 0 for handwriting on a simulated sensor.
    """
    classes = len(sensor.classes)
    if size.name == "small" and not n_samples:
        return suggest_architecture(sensor, on_events=True)
    if not size.is_for(sensor, n_samples):
        return suggest_architecture(sensor, True, choose_hidden_units(size, n_samples, classes))
    side = math.sqrt(sensor.rows * sensor.columns)
    stride = max(size.stride, math.floor(side / EVENT_MAP))
    convolution = f"{size.filters}c{stride + size.overlap}s{stride}"
    return f"{sensor.rows}x{sensor.columns}x2-{convolution}-{size.hidden}-{classes}o"
