"""The hyperparameters of a network on events and of its training."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace

import numpy as np

from deploy.network.stimulus import EventFrames
from models.architecture import parse_architecture
from models.spiking.network import Neuron, SpikingNetwork
from pipeline.recordings.augmentation import AUGMENTATIONS, Alteration, alter_events
from pipeline.recordings.columns import EventColumns
from pipeline.recordings.spike_frames import EventTable, SpikeLimits, make_spike_frames
from pipeline.settings import EventTraining, Input, Settings
from pipeline.training.event_updates import choose_epochs

# Shares of the training samples with hot and with dead taxels. On ST-MNIST a quarter of each cost
# 1.4 points without faults; with none, one hot taxel cost 6. With a twentieth it costs 3.5.
HOT_SHARE = 0.05
DEAD_SHARE = 0.05


@dataclass(frozen=True)
class EventDesign:
    """Hyperparameters of a network on events and of its training.

    Attributes
    ----------
    architecture : str
        See :mod:`models.architecture`.
    step_ms : float
        Recording time in milliseconds that one step of the chip represents.
    limits : SpikeLimits
        Limits of the input's spikes.
    tau_u_ms, tau_v_ms : tuple of float
        Initial time constants of current and voltage, in milliseconds of recording time.
    floor, beta : float
        See :class:`models.spiking.network.Neuron`.
    section_starts : tuple of int
        First step of each section of a sample.
    epochs, batch_size : int
        0 epochs: as many as :func:`pipeline.training.event_updates.choose_epochs` says.
    learning_rate : float
        Learning rate of Adam after a short warm-up; it then falls to 0 along a half cosine.
    average : float
        Decay per batch of the running mean of the weights; the running mean is the result.
    dropout : float
        Share of a layer's neurons whose spikes are dropped in a sample.
    early, price, budget : float
        See :mod:`pipeline.training.events`.
    alteration : Alteration
        Augmentation of training samples, drawn again in each epoch.
    """

    architecture: str = EventTraining.architecture
    step_ms: float = Input.step
    limits: SpikeLimits = field(default_factory=lambda: SpikeLimits.from_settings(Input()))
    tau_u_ms: tuple = (30.0,)
    tau_v_ms: tuple = (80.0,)
    floor: float = -2.0
    beta: float = 4.0
    section_starts: tuple = (0,)
    epochs: int = EventTraining.epochs
    batch_size: int = EventTraining.batch_size
    learning_rate: float = EventTraining.learning_rate
    average: float = 0.998
    dropout: float = EventTraining.dropout
    early: float = EventTraining.early
    price: float = 3.0
    budget: float = EventTraining.budget
    alteration: Alteration = AUGMENTATIONS["space"]

    def alter_samples(self, rng, table: EventTable, indices) -> EventColumns:
        """Some samples altered."""
        events = table.select(indices)
        return alter_events(self.alteration, rng, events, len(indices), self.step_ms, table.size)

    def make_frames(
        self, events: EventColumns, n_samples: int, n_steps: int, size: tuple
    ) -> np.ndarray:
        """Frames of events; see :func:`pipeline.recordings.spike_frames.make_spike_frames`."""
        return make_spike_frames(events, self.step_ms, n_samples, n_steps, size, self.limits)

    def make_frames_of_samples(self, table: EventTable, indices, n_steps: int) -> np.ndarray:
        """Frames of some samples as they are, shape (steps, n_samples, rows, columns, 2)."""
        return table.make_frames(indices, self.step_ms, n_steps, self.limits)

    @classmethod
    def from_settings(cls, settings: Settings) -> EventDesign:
        """Make the design from the settings."""
        inputs = settings.input
        values = asdict(settings.events)
        alteration = values.pop("augment")
        if alteration == "auto":  # still open only for handwriting on the simulated sensor
            alteration = "space"
        alteration = AUGMENTATIONS[alteration]
        if alteration.hot:  # "none" has no faults either
            alteration = replace(alteration, hot=HOT_SHARE, dead=DEAD_SHARE)
        values |= {
            "step_ms": inputs.step,
            "limits": SpikeLimits.from_settings(inputs),
            "section_starts": settings.events.find_section_starts(inputs.step_ms),
        }
        del values["parts"], values["part"], values["size"]
        return cls(**values, alteration=alteration)

    def with_epochs_for(self, n_samples: int) -> EventDesign:
        """The design with its number of epochs, for some number of training samples."""
        if self.epochs:
            return self
        return replace(self, epochs=choose_epochs(n_samples, self.batch_size))

    @property
    def stimulus(self) -> EventFrames:
        """The input of the chip."""
        return EventFrames(
            self.step_ms / 1000, self.limits.refractory_steps, self.limits.max_spikes
        )

    @property
    def neuron(self) -> Neuron:
        """The neurons, with time constants in steps."""
        return Neuron(
            tau_u=tuple(tau / self.step_ms for tau in self.tau_u_ms),
            tau_v=tuple(tau / self.step_ms for tau in self.tau_v_ms),
            floor=self.floor,
            beta=self.beta,
        )

    def make_network(self, seed: int = 0) -> SpikingNetwork:
        """The network with its initial weights."""
        return SpikingNetwork(
            parse_architecture(self.architecture), self.neuron, seed, self.section_starts
        )
