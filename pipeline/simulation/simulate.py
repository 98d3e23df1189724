"""Simulate a data set on the skin: writers, contact, receptors, faults, ACES read-out."""

import hashlib
import itertools
import json
from dataclasses import dataclass, field, replace

import numpy as np
from joblib import delayed

from deploy.errors import UserError
from pipeline.jobs import call_in_processes
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.recordings.chunks import chunk_events
from pipeline.recordings.recordings import Recordings, Source, join_recordings
from pipeline.recordings.sensor import GRID, Sensor, TaxelMap
from pipeline.simulation import aces, handwriting
from pipeline.simulation.contact import Creep, Receptors, add_vibration, press_skin
from pipeline.simulation.parameters import DEFAULT_POPULATION, Parameters, read_parameters
from pipeline.simulation.spurious_events import draw_spurious_events

# Part of the hash of the recordings; increase it with any change of the simulation.
VERSION = 8

# Rows and columns of the paper's array.
SIZE = (GRID, GRID)

# Time step of motion and contact; events have a finer grid.
STEP_S = 3.27e-3 / 3

# Recordings whose film and receptors are simulated together. Fixed, so that the bytes do not depend
# on the processes.
BATCH = 128


@dataclass(frozen=True)
class PlannedRecording:
    """A sample to be recorded.

    Attributes
    ----------
    digit : int
    index : int
        Its number among the samples of the digit.
    writer : int
    trace : pipeline.simulation.handwriting.Trace or None
        Recorded handwriting; None for what a simulated writer writes.
    """

    digit: int
    index: int
    writer: int
    trace: handwriting.Trace | None = None

    @property
    def name(self):
        """The id of the sample, independently of the other samples."""
        return f"{self.digit}/{self.index:04d}"


@dataclass(frozen=True)
class TouchSignal:
    """One recording up to the signal of the taxels, and the parameters of the remaining steps.

    Attributes
    ----------
    start_s : float
        Time of the first row.
    taxels : ndarray of int, shape (n,)
    felt : ndarray of float32, shape (n_times, n)
    speed : ndarray of float, shape (n_times,)
        Speed of the tip, in taxels per second.
    skin : section ``[skin]`` of the parameters
        Parameters of the skin, with the roughness of this recording.
    session : float
        Session of the recording, see :class:`pipeline.simulation.handwriting.Writer`.
    rng : numpy.random.Generator
        Generator in the state after the pen's movement.
    """

    start_s: float
    taxels: np.ndarray
    felt: np.ndarray
    speed: np.ndarray
    skin: object
    session: float
    rng: np.random.Generator


@dataclass(frozen=True)
class SimulationSetup:
    """Who writes on which skin.

    Attributes
    ----------
    parameters : pipeline.simulation.parameters.Parameters
        Default: the built-in ones.
    traces : tuple of pipeline.simulation.handwriting.Trace
        Recorded handwriting to press on the skin instead of that of simulated writers; empty for
        theirs.
    size : (int, int)
        Rows and columns of the skin.
    """

    parameters: Parameters = field(default_factory=read_parameters)
    traces: tuple = ()
    size: tuple = SIZE


def simulate_recordings(
    seed=0, samples_per_digit=None, jobs=2, advance=None, setup: SimulationSetup | None = None
) -> Recordings:
    """Simulate recordings of the paper's rig; they are marked as simulated.

    On a skin of another size the digits are scaled, so that they fill it like the paper's skin.
    The taxels, and the spread of a force over them, are the same.

    Parameters
    ----------
    seed : int
        The same seed gives the same recordings for any number of processes.
    samples_per_digit : sequence of 10 int, optional
        Default: as published, :data:`pipeline.paper.SAMPLES_PER_DIGIT`.
    jobs : int
        Number of processes.
    advance : callable, optional
        Called with the number of recordings finished since the last call.
    setup : SimulationSetup, optional

    Returns
    -------
    Recordings

    Raises
    ------
    ValueError
        The counts are not ten numbers of 0 or more.
    UserError
        A digit is requested that no trace has.
    """
    setup = setup or SimulationSetup()
    parameters = setup.parameters
    size = setup.size
    counts = _make_counts(samples_per_digit)
    samples = list_samples(seed, counts, parameters.population.people, setup.traces)
    batches = [samples[first : first + BATCH] for first in range(0, len(samples), BATCH)]
    parts = []
    work = (delayed(_simulate_batch)(seed, batch, parameters, size) for batch in batches)
    with call_in_processes(work, jobs) as results:
        for batch_events in results:
            parts += batch_events
            if advance:
                advance(len(batch_events))
    return join_recordings(
        parts,
        labels=[sample.digit for sample in samples],
        ids=[sample.name for sample in samples],
        writers=[sample.writer for sample in samples],
        source=make_source(seed, counts, setup),
        taxels=TaxelMap.grid(*size),
        sensor=Sensor(*size),
    )


def make_source(seed=0, samples_per_digit=None, setup: SimulationSetup | None = None) -> Source:
    """The source (name and hash) of :func:`simulate_recordings` with the same arguments."""
    setup = setup or SimulationSetup()
    parameters = setup.parameters
    traces = setup.traces
    size = setup.size
    content = [VERSION, int(seed), _make_counts(samples_per_digit), parameters.compute_hash()]
    if tuple(size) != SIZE:
        content.append(list(size))
    digest = hashlib.sha256(json.dumps(content).encode())
    for trace in traces:
        digest.update(np.array([trace.digit, trace.writer]).tobytes())
        for stroke in trace.strokes:
            digest.update(np.ascontiguousarray(stroke).tobytes())
    peculiarities = _describe_peculiarities(parameters, bool(traces))
    if tuple(size) != SIZE:
        peculiarities.append(f"{size[0]}x{size[1]} taxels")
    name = ", ".join([f"simulated, seed {seed}", *peculiarities])
    return Source(name, digest.hexdigest(), True)


def _describe_peculiarities(parameters, has_traces) -> list:
    """The differences from the default recordings, a few words for each."""
    population = parameters.population
    texts = ["recorded handwriting"] if has_traces else []
    if population.chunked_share:
        texts.append("in chunks" if population.chunked_share == 1 else "some in chunks")
    if not has_traces:
        texts += _describe_writers(population, parameters.writers)
    if population.mixed_form_share:
        percent = 100 * population.mixed_form_share
        texts.append(f"{percent:g} % placed and pressed like any digit")
    return texts


def _describe_writers(population, writers) -> list:
    """The differences of the simulated people from the default ones, a few words for each."""
    texts = []
    if population.people != DEFAULT_POPULATION.people:
        texts.append(f"{population.people} people")
    if writers.backwards[0] != DEFAULT_POPULATION.reversed_share:
        texts.append(f"{100 * writers.backwards[0]:g} % reversed")
    if writers.tablet != DEFAULT_POPULATION.tablet_share:
        texts.append(f"{100 * writers.tablet:g} % as on a tablet")
    return texts


def _make_counts(samples_per_digit):
    counts = SAMPLES_PER_DIGIT if samples_per_digit is None else samples_per_digit
    counts = [int(n) for n in counts]
    if len(counts) != 10 or min(counts) < 0:
        raise ValueError("samples_per_digit: ten numbers, none below 0")
    return counts


def list_samples(seed, counts, people, traces=()) -> list:
    """The samples of a data set.

    Parameters
    ----------
    seed : int
    counts : sequence of 10 int
        Samples of each digit, which are shared out among all people.
    people : int
    traces : sequence of pipeline.simulation.handwriting.Trace, optional
        Recorded handwriting; each is used once, in random order, before any is used again.

    Returns
    -------
    list of PlannedRecording

    Raises
    ------
    UserError
        A digit is requested that no trace has.
    """
    if not traces:
        return [
            PlannedRecording(digit, index, index * people // count)
            for digit, count in enumerate(counts)
            for index in range(count)
        ]
    samples = []
    for digit, count in enumerate(counts):
        pool = [trace for trace in traces if trace.digit == digit]
        if count and not pool:
            raise UserError(f"the recorded handwriting has no {digit}; request none")
        deal = np.random.default_rng([seed, 3, digit])
        rounds = [deal.permutation(len(pool)) for _ in range(-(-count // max(len(pool), 1)))]
        chosen = np.concatenate([np.empty(0, int), *rounds])[:count]
        samples += [
            PlannedRecording(digit, index, pool[one].writer, pool[one])
            for index, one in enumerate(chosen)
        ]
    return samples


def _simulate_batch(seed, samples, parameters, size):
    """Events of some recordings; runs in a process of its own."""
    gain = compute_gain(parameters.skin, size)
    touches = [
        _simulate_touch(sample, *begin_sample(seed, sample, parameters), gain, parameters, size)
        for sample in samples
    ]
    events = _receive(touches, parameters, size)
    chunked_share = parameters.population.chunked_share
    for number, sample in enumerate(samples):
        # Spread evenly over the recordings of a digit.
        if (sample.index * chunked_share) % 1 + chunked_share >= 1:
            events[number] = chunk_events(events[number])
    return events


def begin_sample(seed, sample, parameters):
    """The writer of a sample, and the generator of all that differs between recordings."""
    rng = np.random.default_rng([seed, 2, sample.digit, sample.index])
    if sample.trace is None:
        who = handwriting.draw_writer(np.random.default_rng([seed, 1, sample.writer]), parameters)
    else:
        session = np.random.default_rng([seed, 1, sample.writer + 1]).random()
        who = replace(handwriting.NOBODY, session=session)
    return who, rng


def compute_gain(skin, size=SIZE) -> np.ndarray:
    """Gain of each taxel, shape (n_taxels,): that of the real array, repeated on a larger skin.

    Parameters
    ----------
    skin : section ``[skin]`` of the parameters
    size : (int, int)
        Rows and columns of the skin.
    """
    taxels = TaxelMap.grid(*size)
    gain = np.reshape(skin.gain, SIZE)  # by columns and rows
    return np.exp(gain[taxels.column % GRID, taxels.row % GRID])


def scale_motion(moved, size):
    """A motion over the paper's skin as one over a skin of another size, around its middle.

    The smaller side determines the scale, so that digits keep their proportions.
    """
    if tuple(size) == SIZE:
        return moved
    scale = min(size) / GRID
    down, right = (
        (n - 1) / 2 + scale * (at - (GRID - 1) / 2)
        for n, at in zip(size, (moved.down, moved.right), strict=True)
    )
    return replace(moved, down=down, right=right)


def draw_form(digit, rng, parameters):
    """Place, size, force and contact of one recording: those of its digit, or of any digit."""
    mixed_form_share = parameters.population.mixed_form_share
    if mixed_form_share and rng.random() < mixed_form_share:
        digit = rng.integers(len(parameters.forms))
    return parameters.forms[digit]


def draw_motion(sample, who, rng, form, parameters):
    """The pen's movement over the skin for one recording, force included.

    Parameters
    ----------
    sample : PlannedRecording
    who : pipeline.simulation.handwriting.Writer
    rng : numpy.random.Generator
    form : pipeline.simulation.parameters.Form
    parameters : Parameters

    Returns
    -------
    pipeline.simulation.handwriting.Motion
    """
    kinematics = parameters.kinematics
    if sample.trace is None:
        shape = handwriting.draw_shape(sample.digit, who, rng, parameters.shapes)
        strokes = handwriting.write_digit(sample.digit, shape, who, parameters)
    else:
        strokes = sample.trace.strokes
    start = rng.uniform(*kinematics.onset_s)
    # Limits the deviations to plausible ones.
    faster, harder = np.clip(rng.standard_normal(2), -2.5, 2.5)
    tempo = np.exp(who.tempo + parameters.shapes.trial_tempo * faster)
    force = (
        form.force
        + who.force
        + np.sqrt(1 - parameters.writers.habit) * parameters.trials.force * harder
    )
    placing = handwriting.draw_placing(who, rng, form, parameters.writers.habit)
    strokes = [placing(stroke) for stroke in strokes]
    length = handwriting.measure_duration_s(strokes, kinematics)
    # The writing must end within the recording.
    tempo = max(tempo, length / (kinematics.end_s - start - kinematics.settle_s))
    moved = handwriting.move_pen(strokes, tempo, STEP_S, start, kinematics)
    return replace(moved, force=np.exp(force) * moved.force * _draw_waver(moved, rng, kinematics))


def _draw_waver(motion, rng, kinematics):
    """Slow changes of the force along the movement, with a geometric mean of 1."""
    along = (motion.time_s - motion.time_s[0]) / kinematics.waver_s
    knots = rng.standard_normal(int(along[-1]) + 2)
    return np.exp(kinematics.waver * np.interp(along, np.arange(len(knots)), knots))


def _simulate_touch(sample, who, rng, gain, parameters, size):
    form = draw_form(sample.digit, rng, parameters)
    moved = scale_motion(draw_motion(sample, who, rng, form, parameters), size)
    skin = draw_skin(who, rng, parameters, form.contact)
    gain = gain * np.exp(parameters.skin.gain_drift * rng.standard_normal(len(gain)))
    taxels, felt, speed = press_skin(moved, gain, parameters.receptor.threshold / 2, skin, size)
    return TouchSignal(moved.time_s[0], taxels, felt, speed, skin, who.session, rng)


def draw_skin(who, rng, parameters, contact=0.0):
    """Section ``[skin]`` with the width of the contact and the roughness of one recording.

    Parameters
    ----------
    who : pipeline.simulation.handwriting.Writer
    rng : numpy.random.Generator
    parameters : Parameters
    contact : float
        Logarithm of the digit's factor on the width of the contact.
    """
    wider, rougher = np.clip(rng.standard_normal(2), -2.5, 2.5)
    rougher *= np.sqrt(1 - parameters.writers.habit)
    return replace(
        parameters.skin,
        spread=parameters.skin.spread * np.exp(contact + parameters.skin.spread_spread * wider),
        scrape=parameters.skin.scrape * np.exp(who.scrape + parameters.trials.scrape * rougher),
    )


def _receive(touches, parameters, size):
    """Film and receptors of a batch of recordings in parallel, then the read-out of each recording.

    The recordings are sorted by decreasing length, so that the columns of those that have not ended
    are always the first ones.
    """
    order = sorted(range(len(touches)), key=lambda index: -len(touches[index].felt))
    longest_first = [touches[index] for index in order]
    signal, columns, stretches = _join_signals(longest_first)
    film = Creep(signal.shape[1], STEP_S, parameters.skin)
    for stretch in stretches:
        film.advance(stretch)
    receptors = _draw_receptors(longest_first, signal, columns, parameters.receptor)
    fired = [receptors.advance(stretch) for stretch in stretches]
    time, channel, polarity = map(np.concatenate, zip(*fired, strict=True))
    spikes_of_touches = _split_by_touch(channel, columns)
    events = [None] * len(touches)
    for index, span, own in zip(order, columns, spikes_of_touches, strict=True):
        touch = touches[index]
        seconds = time[own] + touch.start_s - STEP_S
        written = seconds, touch.taxels[channel[own] - span.start], polarity[own]
        events[index] = _read_out(written, touch, parameters, size)
    return events


def _join_signals(touches) -> tuple:
    """The pressure of touches side by side, the longest first.

    Returns
    -------
    signal : ndarray of float32, shape (steps, taxels)
        With one row before the pen touches the skin.
    columns : list of slice
        The columns of each touch.
    stretches : list of ndarray
        Views of the signal with the same touches in all rows, one after the other.
    """
    first = np.cumsum([0] + [len(touch.taxels) for touch in touches])
    columns = list(itertools.starmap(slice, itertools.pairwise(first)))
    ends = [1 + len(touch.felt) for touch in touches]
    signal = np.empty((ends[0], first[-1]), np.float32)
    signal[0] = 0
    for touch, end, span in zip(touches, ends, columns, strict=True):
        signal[1:end, span] = touch.felt
    stretches = [signal[stretch] for stretch in _find_stretches(ends, first)]
    return signal, columns, stretches


def _draw_receptors(touches, signal, columns, receptor) -> Receptors:
    """The receptors of touches, after the vibration of each has been added to its signal."""
    n_taxels = signal.shape[1]
    off, clock = np.empty((2, n_taxels))
    for touch, span in zip(touches, columns, strict=True):
        rng = touch.rng
        add_vibration(signal[1 : 1 + len(touch.felt), span], touch.speed, rng, touch.skin)
        off[span] = np.exp(receptor.off + receptor.off_spread * rng.standard_normal())
        clock[span] = np.exp(receptor.clock * np.abs(rng.standard_normal(len(touch.taxels))))
    return Receptors(
        signal[0],
        on=np.full(n_taxels, receptor.threshold, np.float32),
        off=(receptor.threshold * off).astype(np.float32),
        step_s=STEP_S,
        refractory_s=receptor.refractory_s * clock,
        poll_s=receptor.poll_s * clock,
    )


def _split_by_touch(channel, columns) -> list:
    """Indices of the spikes of each touch, given the column of each spike."""
    widths = [span.stop - span.start for span in columns]
    touch = np.repeat(np.arange(len(columns)), widths)[channel]
    by_touch = np.argsort(touch, kind="stable")
    return np.split(by_touch, np.searchsorted(touch[by_touch], np.arange(1, len(columns))))


def _read_out(written, touch, parameters, size):
    """The decoder's reports of what the pen and the faults have caused."""
    parts = [written]
    if len(written[0]):
        begin = written[0].min()
        end = written[0].max()
        refractory_s = parameters.receptor.refractory_s
        parts.append(
            draw_spurious_events(
                touch.rng, touch.session, (begin, end), refractory_s, parameters.faults, size
            )
        )
    seconds, taxel, polarity = map(np.concatenate, zip(*parts, strict=True))
    return aces.make_bursts(1e9 * seconds, taxel, polarity, parameters.aces)


def _find_stretches(ends, first):
    """Rows between the ends of two recordings, and the columns of those that continue.

    Parameters
    ----------
    ends : sequence of int
        Row after the last one of each recording, the longest first.
    first : sequence of int
        Column at which each begins, and the one after the last.

    Yields
    ------
    (slice, slice)
        From row 1 on.
    """
    row = 1
    for end, column in zip(ends[::-1], first[:0:-1], strict=True):
        if end > row:
            yield slice(row, end), slice(column)
            row = end
