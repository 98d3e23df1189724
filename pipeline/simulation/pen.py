"""The simulated skin under a real pen, step by step while a person writes.

The motion of a simulated writer is known completely before the skin is simulated.  Here the points
of the pen arrive one by one.  Between two of them the tip moves in a straight line, after the last
one it rests, and it lands and lifts like a simulated writer's
(:func:`pipeline.simulation.handwriting.compute_contact_force`).  Contact, film, receptors and
read-out are those of the simulation (:mod:`pipeline.simulation.contact`,
:mod:`~pipeline.simulation.aces`); the skin has no faults.
"""

from typing import NamedTuple

import numpy as np

from pipeline.recordings.events import Events, join_events
from pipeline.simulation import aces
from pipeline.simulation.contact import Creep, Receptors, add_vibration, spread_force
from pipeline.simulation.handwriting import NOBODY, compute_contact_force
from pipeline.simulation.simulate import SIZE, STEP_S, compute_gain, draw_skin

# Time at which the pen first touches the skin; 0.197 s in the one available real recording.
START_S = 0.2

# Pressure that a pointer without a pressure sensor reports (W3C, Pointer Events, ``pressure``).
USUAL_PRESSURE = 0.5

# Bounds of a pen's force, as multiples of the usual one.
MIN_FORCE_FACTOR = 0.3
MAX_FORCE_FACTOR = 2.0

# Taxels beyond the first and the last ones' centres within which a pen may be.
MARGIN_TAXELS = 2.0


class PenPoint(NamedTuple):
    """A position of the pen.

    Attributes
    ----------
    time_s : float
        Time from the start of the recording.
    down, right : float
        Position of the tip in taxels; 0 is the centre of the first row or column.
    pressure : float
        From 0 to 1; :data:`USUAL_PRESSURE` if it is not measured.
    touches : bool
        True if the pen is on the skin from this point on.
    """

    time_s: float
    down: float
    right: float
    pressure: float
    touches: bool


class Writing:
    """A recording that grows.

    Parameters
    ----------
    seed : sequence of int
        Seed of everything that differs between recordings: gains, thresholds, clocks, noise.
    parameters : pipeline.simulation.parameters.Parameters
    size : (int, int)
        Rows and columns of the skin.  The taxels, and the spread of a force over them, are the same
        on every skin.
    polarities : int
        1 for taxels that report only ON events.
    """

    def __init__(self, seed, parameters, size=SIZE, polarities=2):
        rng = np.random.default_rng(seed)
        gain = compute_gain(parameters.skin, size)
        n_taxels = len(gain)
        gain = gain * np.exp(parameters.skin.gain_drift * rng.standard_normal(n_taxels))
        off = np.exp(
            parameters.receptor.off + parameters.receptor.off_spread * rng.standard_normal()
        )
        off *= parameters.receptor.threshold
        clock = np.exp(parameters.receptor.clock * np.abs(rng.standard_normal(n_taxels)))
        self._parameters = parameters
        self._rng = rng
        self._size = size
        self._polarities = polarities
        # The digit is not known: force and contact are the means of all digits.
        self._usual = np.exp(np.mean([form.force for form in parameters.forms]))
        contact = np.mean([form.contact for form in parameters.forms])
        self._gain = gain.astype(np.float32)
        self._skin = draw_skin(NOBODY, rng, parameters, contact)
        self._film = Creep(n_taxels, STEP_S, parameters.skin)
        self._receptors = Receptors(
            np.zeros(n_taxels, np.float32),
            on=np.full(n_taxels, parameters.receptor.threshold, np.float32),
            off=np.full(n_taxels, off, np.float32),
            step_s=STEP_S,
            refractory_s=parameters.receptor.refractory_s * clock,
            poll_s=parameters.receptor.poll_s * clock,
        )
        self._decoder = aces.Decoder(parameters.aces)
        self._row = 0  # rows processed by the receptors, without the first, untouched one
        self._points = []
        self._contacts = []  # [landed, lifted or infinity]
        self._last = None  # (down, right, force) of the last row
        self._parts = []

    @property
    def time_s(self) -> float:
        """The time that the recording has reached."""
        return START_S + self._row * STEP_S

    @property
    def settled_s(self) -> float:
        """Time at which the skin has come to rest, if the pen does not come back; else infinity."""
        if not self._contacts:
            return START_S
        return self._contacts[-1][1] + self._parameters.kinematics.settle_s

    @property
    def events(self) -> Events:
        """All events so far."""
        if len(self._parts) > 1:
            self._parts = [join_events(self._parts)]
        return self._parts[0] if self._parts else Events(*(np.empty(0),) * 4)

    def add_point(self, point: PenPoint):
        """Add a point of the pen.

        Simulated steps do not change: an earlier point counts as one at :attr:`time_s`.

        Raises
        ------
        ValueError
            A value is not a finite number, or the point is nowhere near the skin.
        """
        if not np.isfinite(point[:4]).all():
            raise ValueError("a point of the pen is not four finite numbers")
        places = zip((point.down, point.right), self._size, strict=True)
        if not all(-MARGIN_TAXELS <= place <= side - 1 + MARGIN_TAXELS for place, side in places):
            raise ValueError("a point of the pen is outside the skin")
        before = self._points[-1] if self._points else None
        earliest = self.time_s if before is None else max(self.time_s, before.time_s)
        point = point._replace(
            time_s=max(point.time_s, earliest), pressure=min(max(point.pressure, 0.0), 1.0)
        )
        touched = before is not None and before.touches
        if point.touches and not touched:
            if before is not None:  # the pen moved here through the air
                self._points.append(point._replace(touches=False))
            self._contacts.append([point.time_s, np.inf])
        elif touched and not point.touches:
            self._contacts[-1][1] = point.time_s
        self._points.append(point)

    def advance(self, until_s: float) -> Events:
        """Advance the time and return the events of this interval.

        Parameters
        ----------
        until_s : float
            Time from the start of the recording; before :attr:`time_s` nothing happens.
        """
        n = int((until_s - self.time_s) / STEP_S)
        if n <= 0 or not self._points:
            return Events(*(np.empty(0),) * 4)
        time = START_S + STEP_S * np.arange(self._row + 1, self._row + n + 1)
        down, right, force = self._locate_tip(time)
        if self._last is None:
            self._last = down[0], right[0], 0.0
        # A row's speed is computed from the previous row; the next one is not known yet.
        speed = np.hypot(
            np.diff(down, prepend=self._last[0]), np.diff(right, prepend=self._last[1])
        )
        signal = spread_force(down, right, force, self._skin, self._size)
        signal *= self._gain
        self._film.advance(signal)
        add_vibration(signal, speed / STEP_S, self._rng, self._skin)
        seconds, taxel, polarity = self._receptors.advance(signal)
        if self._polarities == 1:
            seconds, taxel, polarity = (a[polarity > 0] for a in (seconds, taxel, polarity))
        self._row += n
        self._last = down[-1], right[-1], force[-1]
        self._forget()
        events = self._decoder.advance(
            1e9 * (START_S + seconds), taxel, polarity, 1e9 * self.time_s
        )
        if len(events):
            self._parts.append(events)
        return events

    def _locate_tip(self, time_s):
        """Position and force of the tip at some times, each shape (n,)."""
        knots = np.array([(p.time_s, p.down, p.right, p.pressure) for p in self._points])
        down, right, pressure = (np.interp(time_s, knots[:, 0], knots[:, i]) for i in (1, 2, 3))
        kinematics = self._parameters.kinematics
        lands_s, lifts_s = np.array(self._contacts).T + kinematics.landing_s
        force = self._usual * np.clip(pressure / USUAL_PRESSURE, MIN_FORCE_FACTOR, MAX_FORCE_FACTOR)
        return down, right, force * compute_contact_force(time_s, lands_s, lifts_s, kinematics)

    def _forget(self):
        """Delete data on which no later row depends."""
        now = self.time_s
        later = next((i for i, p in enumerate(self._points) if p.time_s > now), len(self._points))
        self._points = self._points[max(later - 1, 0) :]
        settled = now - self._parameters.kinematics.settle_s
        self._contacts = [c for c in self._contacts if c[1] > settled] or self._contacts[-1:]
