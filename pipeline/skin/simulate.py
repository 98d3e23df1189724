"""A whole data set written on the simulated skin: writers, contact, receptors, ACES read-out."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace

import numpy as np
from joblib import Parallel, delayed

from pipeline.recordings import (
    GRID,
    N_TAXELS,
    TICK_NS,
    Events,
    Recordings,
    Source,
    TaxelMap,
    collect,
)
from pipeline.skin import handwriting
from pipeline.skin import parameters as settings
from pipeline.skin.contact import press
from pipeline.skin.receptors import fire

VERSION = 1
"""Goes into the hash of the recordings; raise it with any change of what is simulated."""

SAMPLES_PER_DIGIT = (697, 690, 699, 690, 690, 693, 698, 704, 697, 695)
"""Recordings of each digit in the published data (paper, Table 1)."""

STEP_S = 3.27e-3 / 3
"""Time step of motion and contact; events stand on a finer grid within it."""

BATCH = 64
"""Recordings whose receptors are simulated together.

Fixed, so that the bytes do not depend on the processes.
"""


@dataclass(frozen=True)
class Touch:
    """One recording up to the taxels' signal, before the receptors."""

    start_s: float
    taxels: np.ndarray
    signal: np.ndarray
    off: float
    longer: np.ndarray
    rng: np.random.Generator


def simulate(seed=0, samples_per_digit=None, jobs=2, advance=None, parameters=None) -> Recordings:
    """Recordings as the paper's rig would have made them.  They are simulated, and say so.

    Parameters
    ----------
    seed : int
        The same seed gives the same recordings, whatever the number of processes.
    samples_per_digit : sequence of 10 int, optional
        Default: as published, :data:`SAMPLES_PER_DIGIT`.
    jobs : int
        Processes.
    advance : callable, optional
        Called with the number of recordings that are done since the last call.
    parameters : pipeline.skin.parameters.Parameters, optional
        Default: the built-in ones.

    Returns
    -------
    Recordings
    """
    parameters = parameters or settings.load()
    counts = _counts(samples_per_digit)
    samples = [
        (digit, index, index * parameters.writers.count // counts[digit])
        for digit in range(10)
        for index in range(counts[digit])
    ]
    batches = [samples[first : first + BATCH] for first in range(0, len(samples), BATCH)]
    parts = []
    work = (delayed(_batch)(seed, batch, parameters) for batch in batches)
    for done in Parallel(n_jobs=jobs, return_as="generator")(work):
        parts += [Events(*columns) for columns in done]
        if advance:
            advance(len(done))
    return collect(
        parts,
        labels=[digit for digit, _, _ in samples],
        ids=[f"{digit}/{index:04d}" for digit, index, _ in samples],
        writers=[who for _, _, who in samples],
        source=source_of(seed, counts, parameters),
    )


def source_of(seed=0, samples_per_digit=None, parameters=None) -> Source:
    """What :func:`simulate` of the same arguments will give, by name and hash, without the work."""
    parameters = parameters or settings.load()
    text = json.dumps([VERSION, int(seed), _counts(samples_per_digit), parameters.fingerprint()])
    return Source(f"simulated, seed {seed}", hashlib.sha256(text.encode()).hexdigest(), True)


def _counts(samples_per_digit):
    counts = [int(n) for n in (samples_per_digit or SAMPLES_PER_DIGIT)]
    if len(counts) != 10 or min(counts) < 0:
        raise ValueError("samples_per_digit: ten numbers, none below 0")
    return counts


def _batch(seed, samples, p):
    """Columns of Events for some recordings; runs in a process of its own."""
    people, gain = _people(seed, p)
    touches = [
        _touch(digit, people[who], gain, np.random.default_rng([seed, 2, digit, index]), p)
        for digit, index, who in samples
    ]
    return _receive(touches, p)


def _people(seed, p):
    people = [
        handwriting.writer(np.random.default_rng([seed, 1, who]), p.writers)
        for who in range(p.writers.count)
    ]
    taxels = TaxelMap()
    centre = (GRID - 1) / 2
    lean = p.skin.lean[0] * (taxels.x - centre) + p.skin.lean[1] * (taxels.y - centre)
    scatter = np.random.default_rng([seed, 0]).standard_normal(N_TAXELS)
    gain = np.exp(lean + p.skin.gain * scatter)
    return people, gain


def _touch(digit, who, gain, rng, p):
    form = p.forms[digit]
    placed = handwriting.plan(digit, who, rng, p.trials, form)
    tempo, force, off = rng.standard_normal(3)
    tempo = np.exp(form.spread * (who.tempo + p.trials.tempo * tempo))
    force = np.exp(form.force + form.spread * (who.force + p.trials.force * force))
    start = rng.uniform(*p.kinematics.onset_s)
    motion = handwriting.move(placed, tempo, STEP_S, start, p.kinematics)
    motion = _cut(motion, p.kinematics.end_s)
    motion = replace(motion, force=force * motion.force * _waver(motion, rng, p.kinematics))
    skin = replace(
        p.skin, scrape=p.skin.scrape * np.exp(form.spread * p.trials.scrape * rng.standard_normal())
    )
    gain = gain * np.exp(p.skin.gain_drift * rng.standard_normal(N_TAXELS))
    taxels, signal = press(motion, gain, p.receptor.threshold / 2, rng, skin)
    return Touch(
        start_s=motion.time_s[0],
        taxels=taxels,
        signal=signal,
        off=p.receptor.threshold * np.exp(form.off + 0.1 * off),
        longer=np.asarray(p.aces.longer),
        rng=rng,
    )


def _cut(motion, end_s):
    keep = motion.time_s < end_s
    return replace(motion, **{name: getattr(motion, name)[keep] for name in vars(motion)})


def _waver(motion, rng, p):
    """Slow changes of the force along the way, geometric mean 1."""
    length = motion.time_s[-1] - motion.time_s[0]
    knots = rng.standard_normal(int(length / p.waver_s) + 3)
    along = (motion.time_s - motion.time_s[0]) / p.waver_s
    return np.exp(p.waver * np.interp(along, np.arange(len(knots)), knots))


def _receive(touches, p):
    """Receptors of all recordings of a batch side by side, then each recording's read-out."""
    widths = [touch.signal.shape[1] for touch in touches]
    first = np.concatenate([[0], np.cumsum(widths)])
    rows = max(touch.signal.shape[0] for touch in touches) + 1
    signal = np.zeros((rows, first[-1]), np.float32)  # row 0: nobody touches the skin
    clock = np.empty(first[-1])
    off = np.empty(first[-1], np.float32)
    for touch, at, width in zip(touches, first, widths, strict=False):
        signal[1 : 1 + len(touch.signal), at : at + width] = touch.signal
        clock[at : at + width] = np.exp(p.receptor.clock * touch.rng.standard_normal(width))
        off[at : at + width] = touch.off
    on = np.full(first[-1], p.receptor.threshold, np.float32)
    refractory = p.receptor.refractory_s * np.maximum(clock, 1)
    time, channel, polarity = fire(signal, on, off, STEP_S, refractory, p.receptor.poll_s * clock)
    sample = np.searchsorted(first, channel, side="right") - 1
    order = np.argsort(sample, kind="stable")
    bounds = np.searchsorted(sample[order], np.arange(len(touches) + 1))
    parts = []
    for index, touch in enumerate(touches):
        mine = order[bounds[index] : bounds[index + 1]]
        taxel = touch.taxels[channel[mine] - first[index]]
        parts.append(
            _read_out(touch, time[mine] + touch.start_s - STEP_S, taxel, polarity[mine], p)
        )
    return parts


def _read_out(touch, time_s, taxel, polarity, p):
    """Bursts of decoder ticks, no two in the same tick: columns of Events."""
    order = np.argsort(time_s, kind="stable")
    time_s, taxel, polarity = time_s[order], taxel[order], polarity[order]
    longer = touch.rng.random(len(time_s))
    columns = np.where(
        polarity > 0,
        np.where(longer < touch.longer[0], p.aces.on_columns[1], p.aces.on_columns[0]),
        np.where(longer < touch.longer[1], p.aces.off_columns[1], p.aces.off_columns[0]),
    )
    # The decoder reports one taxel a tick: a burst that would start within another waits for it.
    tick = np.round(time_s * 1e9 / TICK_NS).astype(np.int64)
    before = np.cumsum(columns) - columns
    tick = before + np.maximum.accumulate(tick - before)
    return tick * TICK_NS, taxel, polarity, columns
