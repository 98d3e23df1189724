"""Settings of a network on events that follow from the recordings.

For handwriting on the skin the defaults of the settings are used.  They were chosen on thousands of
recordings of ten classes with few events.  For all other recordings the rules of :mod:`.sizes`,
:mod:`.input_choice` and :mod:`pipeline.training.event_updates` choose what suits their number,
their classes and their events, and this module applies the rules to the settings that the user has
left open.  The rules were cross-validated within the training sets of two sets of real recordings
of touch, objects in a robot's hand and Braille letters.
"""

from __future__ import annotations

import math

import numpy as np

from deploy.tables import format_count
from pipeline.kinds.architectures import count_operations_of_event, describe_choice, is_for_sensor
from pipeline.kinds.events.input_choice import choose_input, choose_max_spikes, compute_bin_ms
from pipeline.kinds.events.sizes import (
    FEW_SAMPLES,
    USUAL_EVENTS,
    NetworkSize,
    choose_dropout,
    choose_size,
    suggest_event_architecture,
)
from pipeline.kinds.presentation import choose_presentation, choose_step_ms, choose_time_constants
from pipeline.paper import CNN_MACS
from pipeline.recordings.augmentation import choose_augmentation
from pipeline.recordings.recordings import Recordings, is_handwriting
from pipeline.settings import Choice, Settings, apply_choices
from pipeline.training.event_updates import TAIL_STEPS, choose_epochs

# Synaptic operations that a network on events may take, in multiples of what its first layer takes
# to receive the events: with many classes, the readout takes as many as the first layer.
OPERATIONS_BY_RECEIVED = 4

# Channels of the input: a polarity each.
CHANNELS = 2

# Maximum budget of operations that is chosen, in multiples of the CNN's.
MAX_BUDGET = 1000.0


class EventChoices:
    """The choices for some recordings, one after the other.

    Parameters
    ----------
    settings : Settings
        What the user has set.
    recordings : Recordings
    train : ndarray of int
        Indices of the training samples; none if there can be no split.

    Attributes
    ----------
    choices : list of Choice
    size : NetworkSize
        Size of the network: the user's, or that for the recordings.
    """

    def __init__(self, settings: Settings, recordings: Recordings, train: np.ndarray):
        self.settings = settings
        self.recordings = recordings
        self.table = recordings.table
        self.choices: list[Choice] = []
        self.is_usual = is_handwriting(recordings)
        self.train = train
        self.size = choose_size(settings.events.size, recordings)
        self._choose_step()
        self._choose_presentation()
        self._choose_architecture()
        self._choose_epochs()
        self._choose_augmentation()
        if not self.is_usual:
            self._choose_dropout()
            self._choose_input()

    @property
    def presented(self) -> Settings:
        """The settings with what is chosen so far."""
        return apply_choices(self.settings, self.choices, self.settings.data.source)

    @property
    def longest_ms(self) -> float:
        """Time of the last event of all recordings in milliseconds."""
        return float(self.table.duration_ms.max(initial=0))

    def _choose(self, setting, value, reason=""):
        self.choices.append(Choice(setting, value, reason))

    def _choose_step(self):
        """Events that are counted in bins get a step for each bin."""
        settings = self.settings
        if self.is_usual or not settings.is_open("input.step"):
            return
        bin_ms = compute_bin_ms(self.table)
        if bin_ms is None or bin_ms <= settings.input.step_ms:
            return
        step_ms = choose_step_ms(self.longest_ms, bin_ms, may_shorten=False)
        reason = (
            f"steps of {step_ms:g} ms: the times of the recordings are multiples of {bin_ms:g} ms "
            "(another: --set input.step=...)"
        )
        self._choose("input.step", step_ms, reason)
        self._choose("input.refractory", step_ms)

    def _choose_presentation(self):
        settings = self.presented
        choices = choose_presentation(settings, self.recordings, may_shorten=True)
        is_binned = any(choice.setting == "input.step" for choice in self.choices)
        if is_binned and not choices and not settings.presentation.steps:
            # The spikes of the last bin need some steps to reach the readout.
            n_steps = math.floor(self.longest_ms / settings.input.step_ms) + 1 + TAIL_STEPS
            choices = [Choice("presentation.steps", max(n_steps, settings.steps))]
        self.choices += choices
        self.choices += choose_time_constants(self.presented)

    def _choose_architecture(self):
        """The architecture of the size; the default is the one for simulated handwriting."""
        settings = self.settings
        sensor = self.recordings.sensor
        size = self.size
        is_simulated = self.is_usual and size.name == "small"
        samples = 0 if is_simulated else len(self.train)
        if not settings.is_open("events.architecture"):
            return
        if is_simulated and is_for_sensor(settings.events.architecture, sensor, CHANNELS):
            return
        text = suggest_event_architecture(sensor, size, samples)
        reason = f"{describe_choice('events', text, sensor)}; size {size.name}"
        self.choices.insert(0, Choice("events.architecture", text, reason))
        if settings.is_open("events.budget"):
            self._choose_budget(text, size, samples)

    def _choose_budget(self, architecture: str, size: NetworkSize, n_samples: int):
        events = len(self.recordings.events) / max(len(self.recordings), 1)
        if size.is_for(self.recordings.sensor, n_samples):
            budget = size.budget * max(1, events / USUAL_EVENTS)
        else:
            received = events * count_operations_of_event(architecture) / CNN_MACS
            budget = OPERATIONS_BY_RECEIVED * received
        budget = float(min(round(max(budget, self.settings.events.budget), 1), MAX_BUDGET))
        if budget != self.settings.events.budget:
            self._choose("events.budget", budget)

    def _choose_epochs(self):
        """More passes over the training samples for a size that has them."""
        settings = self.settings
        size = self.size
        if size.passes == 1 or not settings.is_open("events.epochs"):
            return
        default_epochs = choose_epochs(len(self.train), settings.events.batch_size)
        reason = (
            f"{size.passes} times the usual {default_epochs} passes over the training samples; "
            f"size {size.name} (another: --set events.epochs=...)"
        )
        self._choose("events.epochs", size.passes * default_epochs, reason)

    def _choose_augmentation(self):
        if self.settings.events.augment != "auto":
            return
        augmentation = choose_augmentation(self.recordings)
        others = "another: --set events.augment=time, slight, space, none"
        reason = f"augmentation: {augmentation} ({others})"
        self._choose("events.augment", augmentation, reason)

    def _choose_dropout(self):
        size = self.size
        samples = len(self.train)
        dropout = choose_dropout(size, samples)
        is_default = dropout == Settings().events.dropout
        if is_default or not self.settings.is_open("events.dropout"):
            return
        cause = "few recordings" if samples < FEW_SAMPLES else f"size {size.name}"
        reason = f"dropout of {dropout:g}, for {cause} (another: --set events.dropout=...)"
        self._choose("events.dropout", dropout, reason)

    def _choose_input(self):
        """The refractory period, and the sections of the readout."""
        settings = self.settings
        presented = self.presented
        step_ms = presented.input.step_ms
        sections = settings.events.parts
        is_open = settings.is_open("input.refractory")
        reason = ""
        if is_open or not sections:  # what the user has set needs no estimate, which takes seconds
            chosen_input = self._estimate_input(presented)
            sections = sections or chosen_input.n_sections
            reason = chosen_input.describe(step_ms, sections)
        if is_open:
            self._choose("input.refractory", chosen_input.refractory_steps * step_ms, reason)
            reason = ""
        section_ms = settings.events.section_ms or presented.steps * step_ms / sections
        self._choose("events.parts", sections, reason)
        self._choose("events.part", section_ms)
        if settings.is_open("input.max_spikes"):
            self._choose_max_spikes()

    def _choose_max_spikes(self):
        """The maximum number of spikes of a taxel, which bounds the weight of a hot one."""
        presented = self.presented
        max_spikes = choose_max_spikes(self.table, self.train, presented.input, presented.steps)
        if max_spikes == 0:
            return
        most = format_count(max_spikes, "spike")
        reason = (
            f"at most {most} of a taxel and polarity in a recording, so that a taxel that fires "
            "all the time has little weight (another: --set input.max_spikes=...)"
        )
        self._choose("input.max_spikes", max_spikes, reason)

    def _estimate_input(self, presented):
        step_ms = presented.input.step_ms
        labels = self.recordings.labels
        chosen_input = choose_input(self.table, labels, self.train, step_ms, presented.steps)
        if self.settings.is_open("input.refractory"):
            return chosen_input
        chosen = presented.input.refractory_steps
        return chosen_input._replace(
            refractory_steps=chosen, lost=self.table.measure_loss(step_ms, chosen)
        )
