"""A running sensor: events in, decisions of the network out."""

from __future__ import annotations

import math
import time
from numbers import Integral
from pathlib import Path
from typing import List, Optional

import numpy as np

from ..check.bundle import Bundle, read_bundle
from ..errors import UserError
from ..network.provenance import read_classes
from ..targets.emulation import Emulation
from ..terminal import format_command
from .clock import UNIT_NS, SensorClock
from .decider import Decider
from .events import EventReader
from .faults import LOG, Faults
from .presentation import PresentingNetwork, SharedNetwork
from .touch import NANOSECONDS_PER_MS, Decision, Touch, TouchSteps

NUMBERS = (int, float, np.number)

# Number of consecutive touches of one event each from which the unit of the times is doubted.
SINGLE_EVENT_TOUCHES = 5


class Stream:
    """A network that runs on the events of a sensor in real time.

    A touch begins with an event after silence.  Its events are presented to the network step by
    step, as in a check: after the gap, for the steps of the bundle's presentation.  It decides as
    soon as its confidence reaches the bundle's threshold, or else at the end of the presentation;
    if the sensor is silent before, the remaining steps are computed at once.

    Parameters
    ----------
    bundle : Bundle, Run or path-like
        A bundle on events, its run, or the folder of either.
    unit : str
        Unit of the events' times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``.
    silence : float, optional
        Time in seconds without events that ends a touch; default: the longest within a sample of
        the bundle's check, at least the gap of the presentation.
    longest : float, optional
        Time in seconds for which a touch that does not end is presented; default: the
        bundle's presentation.
    stream_length : int, optional
        Number of touches after which the network is reset; default: the bundle's. With 1, no touch
        depends on the one before.
    network : SharedNetwork, optional
        The bundle's network, if several streams share it.

    Attributes
    ----------
    classes : tuple of str
        Names of the classes.
    silence : float
        Time in seconds without events that ends a touch.
    n_events : int
        Number of events that were presented.

    Raises
    ------
    UserError
        The bundle cannot be read, or its network is not on ON and OFF events; Numba is missing.

    Examples
    --------
    >>> stream = Stream("runs/mine")
    >>> for t, x, y, p in sensor:
    ...     for decision in stream.push(t, x, y, p):
    ...         print(decision.label, decision.probability)
    >>> stream.finish()
    """

    def __init__(
        self,
        bundle,
        unit: str = "s",
        silence: Optional[float] = None,
        longest: Optional[float] = None,
        stream_length: Optional[int] = None,
        network: Optional[SharedNetwork] = None,
    ):
        _require_unit(unit)
        bundle = _read_event_bundle(bundle)
        self._spec = spec = bundle.spec
        self.classes = read_classes(spec)
        self.silence = _measure_usual_silence(bundle) if silence is None else float(silence)
        _require_positive_seconds("silence", self.silence)
        self._silence_ns = 1e9 * self.silence
        if longest is not None:
            _require_finite_seconds("longest", longest)
        self._unit = unit
        self._tick_ns = UNIT_NS[unit]
        self._steps = TouchSteps(spec, longest)
        self._faults = Faults()
        self._clock = SensorClock(self._silence_ns, self._faults)
        has_off = spec.provenance.polarities == 2
        self._reader = EventReader(spec.input_shape, has_off, self._tick_ns, self._faults)
        if network is None:
            network = SharedNetwork(Emulation(spec, bundle.seed))
        if stream_length is None:
            stream_length = spec.presentation.stream_length
        _require_stream_length(stream_length)
        presenting = PresentingNetwork(network, stream_length, self._steps.longest)
        self._decider = Decider(presenting, spec, self._steps, self._note_verdict)
        self._touch: Optional[Touch] = None  # the present one, or the last one, which has ended
        self._single_events = 0  # consecutive touches of one event each
        self._has_warned_of_unit = False
        self._due: List[Decision] = []  # decisions that have not been returned
        # Time of the last event on the sensor's clock, and when it arrived on this machine's.
        self._last_ns: Optional[int] = None
        self._arrived_s = 0.0
        self.n_events = 0

    def __repr__(self):
        return f"Stream of {self._spec.architecture}, {self.n_events} events, {self.faults}"

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._faults.report()

    @property
    def faults(self) -> dict:
        """Number of events with each fault so far; see :data:`deploy.stream.faults.FAULTS`.

        ``outside``, ``polarity`` and ``unreadable`` events are not presented.  Those that are
        ``late``, from the ``future`` or at a ``jump`` are presented, in the present step.
        ``surplus`` events belong to a touch, but come after the end of its presentation.
        """
        return dict(self._faults.counts)

    @property
    def step_ns(self) -> float:
        """Duration of a step in nanoseconds; a decision is due at the end of one."""
        return self._steps.step_ms * NANOSECONDS_PER_MS

    @property
    def now(self) -> Optional[float]:
        """Present time on the sensor's clock: its last event's, and the time since it arrived.

        None before the first event.  The clock of this machine tells how long ago that was; a
        program that pushes a recording faster than it was made must therefore give the time to
        :meth:`advance`.
        """
        if self._last_ns is None:
            return None
        waited_ns = 1e9 * (time.monotonic() - self._arrived_s)
        return (self._last_ns + waited_ns) / self._tick_ns

    @property
    def touching(self) -> bool:
        """True from the first event of a touch until silence."""
        return self._touch is not None and not self._touch.has_ended

    @property
    def touch(self) -> Optional[Touch]:
        """The current touch, or the last one."""
        return self._touch

    @property
    def exceeds_training(self) -> bool:
        """True if the current touch, or the last one, is longer than the samples of the training.

        Probabilities are estimated on those samples, and are far too high for slower touches.
        """
        return self._touch is not None and self._steps.exceeds_training(self._touch)

    def push(self, t, x, y, p) -> List[Decision]:
        """Take events that have arrived.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Time of each event on the sensor's clock.
        x, y : int or array_like, shape (n,)
            Column from the left and row from the top.
        p : int, bool or array_like, shape (n,)
            Polarity: 1 or True for ON, 0, -1 or False for OFF.

        Returns
        -------
        list of Decision
            Decisions that have become due.

        Raises
        ------
        UserError
            The columns differ in length.
        """
        if isinstance(t, NUMBERS) and self._push_into_present_step(t, x, y, p):
            return []
        time_ns, cell = self._reader.read(t, x, y, p)
        if not len(time_ns):
            return []
        self._note_arrival(int(time_ns[-1]))
        self._present_events(*self._clock.order(time_ns, cell))
        return self._pop_due_decisions()

    def advance(self, t=None) -> List[Decision]:
        """Advance the clock while no event does; call it a few times per step.

        Push all events before this time first: later ones are presented in the present step.

        Parameters
        ----------
        t : float, optional
            Present time on the sensor's clock; default: :attr:`now`, which is nothing before the
            first event.

        Returns
        -------
        list of Decision
            Decisions that have become due.
        """
        if t is None:
            t = self.now
            if t is None:
                return []
        if isinstance(t, NUMBERS) and self._advance_within_step(t):
            return []
        time_ns, is_valid = self._reader.convert_to_ns(np.atleast_1d(t))
        if not is_valid.all():
            self._faults.record("unreadable")
            return []
        self._present_events(*self._clock.advance(int(time_ns[0])))
        self._advance_touch(self._clock.now_ns)
        return self._pop_due_decisions()

    def finish(self) -> List[Decision]:
        """End the current touch, as silence does, and report the remaining faults.

        Returns
        -------
        list of Decision
            The decision on the touch, unless it was made before.
        """
        self._present_events(*self._clock.release())
        if self.touching:
            self._end_touch(self._clock.now_ns)
        self._faults.report()
        return self._pop_due_decisions()

    def _note_arrival(self, sensor_ns):
        """Note the time of the last event on the sensor's clock, and on this machine's."""
        self._last_ns = sensor_ns
        self._arrived_s = time.monotonic()

    def _push_into_present_step(self, t, x, y, p):
        """Take a single event in the shortest time, if it is in the step that is not over yet.

        Returns
        -------
        bool
            False if it is not, or if anything about it is unusual; nothing has been done then.
        """
        if not self.touching:
            return False
        touch = self._touch
        steps = touch.presentation.n_steps
        try:
            sensor_ns = round(t * self._tick_ns)
            time_ns = self._clock.to_stream_time(sensor_ns)
            is_next = self._clock.is_next(time_ns)
            is_present = time_ns < self._steps.find_certain_end_ns(touch)
            cell = self._reader.find_cell(x, y, p)
        except (TypeError, ValueError, OverflowError):
            return False
        is_presented = steps < self._steps.longest and is_present and is_next
        if cell is None or not is_presented:
            return False
        self._decider.present_now(touch, cell)
        touch.last_ns = time_ns
        self._clock.note(time_ns)
        self._note_arrival(sensor_ns)
        self.n_events += 1
        return True

    def _advance_within_step(self, t):
        """Take the present time in the shortest time, if no step or silence is over."""
        touch = self._touch
        try:
            time_ns = self._clock.to_stream_time(round(t * self._tick_ns))
        except (ValueError, OverflowError):
            return False
        if self.touching:
            if time_ns - touch.last_ns > self._silence_ns:
                return False
            is_running = touch.presentation.n_steps < self._steps.find_last_step(touch)
            if is_running and time_ns >= self._steps.find_certain_end_ns(touch):
                return False
        return self._clock.advance_quietly(time_ns)

    def _pop_due_decisions(self):
        due = self._due
        self._due = []
        return due

    def _present_events(self, time_ns, cell):
        """Present events in order of time, touch by touch."""
        if not len(time_ns):
            return
        self.n_events += len(time_ns)
        ends = np.flatnonzero(np.diff(time_ns) > self._silence_ns) + 1
        for first, end in zip([0, *ends], [*ends, len(time_ns)]):
            self._present_touch(time_ns[first:end], cell[first:end])

    def _present_touch(self, time_ns, cell):
        """Present events without silence between them."""
        if self.touching and time_ns[0] - self._touch.last_ns > self._silence_ns:
            self._end_touch(int(self._touch.last_ns + self._silence_ns))
        if not self.touching:
            self._touch = self._decider.begin(int(time_ns[0]))
        touch = self._touch
        touch.last_ns = max(touch.last_ns, int(time_ns[-1]))
        step = np.maximum(self._steps.find_step(touch, time_ns), touch.presentation.n_steps)
        surplus = len(step) - int(np.searchsorted(step, self._steps.longest))
        if surplus:
            self._faults.record("surplus", surplus)
            step = step[: len(step) - surplus]
            cell = cell[: len(cell) - surplus]
        if len(step):
            self._decider.present(touch, step, cell)
        self._advance_touch(int(time_ns[-1]))

    def _advance_touch(self, now_ns):
        """Present the steps that are over, or end the touch after silence."""
        if not self.touching:
            return
        touch = self._touch
        if now_ns - touch.last_ns > self._silence_ns:
            self._end_touch(int(touch.last_ns + self._silence_ns))
        else:
            self._decider.advance(touch, now_ns)

    def _note_verdict(self, touch, verdict):
        """Convert a verdict to a decision on the sensor's clock, which is now due."""
        touch.decision = Decision(
            label=self.classes[verdict.number],
            number=verdict.number,
            probability=verdict.probability,
            time=self._clock.to_sensor_time(verdict.time_ns) / self._tick_ns,
            start=self._clock.to_sensor_time(touch.start_ns) / self._tick_ns,
            early=verdict.is_early,
            ended=touch.end_ns is not None and verdict.time_ns >= touch.end_ns,
            events=int(touch.events[: verdict.n_steps].sum()),
        )
        self._due.append(touch.decision)

    def _end_touch(self, time_ns):
        self._decider.end(self._touch, time_ns)
        self._warn_of_single_events(self._touch)

    def _warn_of_single_events(self, touch):
        """Warn once if touch after touch has one event, as with times in another unit."""
        self._single_events = self._single_events + 1 if touch.start_ns == touch.last_ns else 0
        if self._single_events == SINGLE_EVENT_TOUCHES and not self._has_warned_of_unit:
            self._has_warned_of_unit = True
            LOG.warning(
                "stream: %d consecutive touches have one event each; if the times are not in "
                "%r, give their unit (unit='us')",
                SINGLE_EVENT_TOUCHES,
                self._unit,
            )


def _require_unit(unit):
    if unit not in UNIT_NS:
        raise UserError(f"unit {unit!r}: not one of {', '.join(UNIT_NS)}")


def _require_stream_length(number):
    if not isinstance(number, Integral) or number < 1:
        raise UserError(f"stream_length {number!r}: must be a whole number from 1")


def _require_finite_seconds(name, seconds):
    _require_positive_seconds(name, seconds)
    if math.isinf(seconds):
        raise UserError(f"{name}: must be finite; leave it out for that of the bundle")


def _require_positive_seconds(name, seconds):
    """Refuse a duration that no touch can have; it may be infinite."""
    if not seconds > 0:
        raise UserError(f"{name} {seconds:g}: must be above 0 seconds")


def _read_event_bundle(bundle_or_run):
    """The bundle of a network on events, which is given, or named by its folder or its run."""
    is_bundle = isinstance(bundle_or_run, Bundle)
    bundle = bundle_or_run if is_bundle else read_bundle(_find_bundle(bundle_or_run))
    _require_events(bundle)
    return bundle


def _find_bundle(bundle_or_run):
    """The folder of a bundle, which is named directly or by its run."""
    path = Path(getattr(bundle_or_run, "path", bundle_or_run))
    inside = path / "bundle"
    return inside if inside.is_dir() and not (path / "MANIFEST.json").exists() else path


def _require_events(bundle):
    """Refuse networks whose input is not the ON and OFF events of a sensor."""
    spec = bundle.spec
    name = bundle.path or "the bundle"
    if spec.stimulus.is_static:
        remedy = format_command("convert", "runs/events", "--input", "events")
        raise UserError(
            f"{name}: its network is on images, which are made of whole recordings; a stream "
            f"needs one on events, such as of {remedy}"
        )
    if len(spec.input_shape) != 3 or spec.input_shape[2] != 2:
        raise UserError(
            f"{name}: its input has the shape {spec.input_shape}; a stream needs a network on ON "
            "and OFF events, (rows, columns, 2)"
        )


def _measure_usual_silence(bundle):
    """Seconds of the longest silence within a sample of the check, at least the gap."""
    spec = bundle.spec
    longest = spec.presentation.gap
    if bundle.checks is not None:
        frames = bundle.checks.inputs
        for busy in frames.reshape(*frames.shape[:2], -1).any(axis=2):
            longest = max(longest, int(np.diff(np.flatnonzero(busy)).max(initial=0)))
    # Within the refractory period, frames do not have all events.
    return (longest + 1) * spec.stimulus.step_seconds
