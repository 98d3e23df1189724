"""Train a spiking network on events for the chip; the network is in :mod:`models.spiking`.

Let c be a sample's label, p(t) the softmax of the outputs at step t, T the step of the last event,
and o the synaptic operations of an inference in multiples of the CNN's (``CNN_MACS``).  The loss is

    - log p_c(end) - early mean over t <= T of log p_c(t) + price max(o - budget, 0)

The first term rewards the right prediction at the end.  The second term rewards an early one and
makes the softmax of the outputs a confidence.  The third term, a penalty on the mean of a
batch, keeps the synaptic operations within the budget: it acts where the operations of the batch
before exceed it.
"""

from pipeline.training.events.checkpoint import Checkpoint, train_epochs
from pipeline.training.events.design import EventDesign
from pipeline.training.events.network import (
    NetworkOutputs,
    TrainedOnEvents,
    build_network,
    delay_as_on_chip,
    run_on_frames,
)
from pipeline.training.events.trainer import train_events

__all__ = [
    "Checkpoint",
    "EventDesign",
    "NetworkOutputs",
    "TrainedOnEvents",
    "build_network",
    "delay_as_on_chip",
    "run_on_frames",
    "train_epochs",
    "train_events",
]
