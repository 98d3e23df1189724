"""Whole simulated recordings."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline.paper import DURATION_S, SAMPLES_PER_DIGIT
from pipeline.recordings.events import EVENT_DTYPES, TICK_NS, expand_bursts, merge_bursts
from pipeline.simulation import parameters
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.simulate import (
    SimulationSetup,
    draw_form,
    list_samples,
    make_source,
    simulate_recordings,
)

FEW = [8] * 10


@pytest.fixture(scope="module")
def recordings():
    return simulate_recordings(5, FEW, jobs=1)


def bytes_of(recordings):
    digest = hashlib.sha256(recordings.offsets.tobytes())
    for name in EVENT_DTYPES:
        digest.update(getattr(recordings.events, name).tobytes())
    return digest.hexdigest()


def test_same_seed_same_bytes_whatever_the_processes():
    # Two batches, so that two processes have something to share.
    counts = [0, 100] + [0] * 8
    assert bytes_of(simulate_recordings(1, counts, jobs=1)) == bytes_of(
        simulate_recordings(1, counts, jobs=2)
    )


def test_labels_and_ids_go_by_digit(recordings):
    np.testing.assert_array_equal(recordings.labels, np.repeat(np.arange(10), 8))
    assert recordings.ids[:2] == ("0/0000", "0/0001")
    assert recordings.ids[-1] == "9/0007"


def test_writers_are_people_of_the_population(recordings):
    assert recordings.writers.min() >= 0
    assert recordings.writers.max() < parameters.DEFAULT_POPULATION.people


def test_recordings_are_called_simulated(recordings):
    assert recordings.source.simulated
    assert "simulated" in recordings.source.name
    assert recordings.source == make_source(5, FEW)


def test_every_writer_writes_every_digit_about_thirty_times():
    samples = list_samples(0, SAMPLES_PER_DIGIT, 23)
    for digit, count in enumerate(SAMPLES_PER_DIGIT):
        each = np.bincount([sample.writer for sample in samples if sample.digit == digit])
        assert (len(each), sum(each)) == (23, count)
        assert set(each) <= {30, 31}


def test_the_hash_is_over_all_that_matters(recordings):
    p = parameters.read_parameters()
    changed = replace(p, skin=replace(p.skin, spread=p.skin.spread + 0.01))
    another = replace(p, shapes=replace(p.shapes, tempo=p.shapes.tempo + 0.1))
    hashes = {
        make_source(5, FEW, SimulationSetup(another)).sha256,
        make_source(5, FEW).sha256,
        make_source(6, FEW).sha256,
        make_source(5, [9, *FEW[1:]]).sha256,
        make_source(5, FEW, SimulationSetup(changed)).sha256,
    }
    assert len(hashes) == 5


def test_a_share_of_the_recordings_has_the_form_of_any_digit():
    p = parameters.read_parameters()
    mixed = replace(p, population=replace(p.population, mixed_form_share=0.5))
    rng = np.random.default_rng(0)
    drawn = [mixed.forms.index(draw_form(3, rng, mixed)) for _ in range(2000)]
    counts = np.bincount(drawn, minlength=10)
    assert counts[3] / 2000 == pytest.approx(0.55, abs=0.05)
    assert np.delete(counts, 3).min() > 50
    before = rng.bit_generator.state
    assert draw_form(3, rng, p) is p.forms[3]
    assert rng.bit_generator.state == before
    sources = {make_source(5, FEW, SimulationSetup(each)) for each in (p, mixed)}
    assert len({source.sha256 for source in sources}) == 2
    assert any("any digit" in source.name for source in sources)


def test_recordings_are_such_as_the_decoder_makes(recordings):
    for index in range(len(recordings)):
        events = recordings[index]
        times, taxel, polarity = expand_bursts(events)
        assert (times % TICK_NS == 0).all()
        assert (np.diff(times) > 0).all()
        assert times[0] > 0.05e9
        assert times[-1] < DURATION_S * 1e9
        again = merge_bursts(times, taxel, polarity)
        for name in EVENT_DTYPES:
            np.testing.assert_array_equal(getattr(again, name), getattr(events, name))
        rises = events.polarity > 0
        assert set(events.columns[rises]) <= {2, 3}
        assert set(events.columns[~rises]) <= {4, 5}


def without_faults():
    p = parameters.read_parameters()
    return replace(p, faults=replace(p.faults, sessions=(), strays=0.0))


def test_no_taxel_fires_twice_within_its_blind_time():
    p = parameters.read_parameters().receptor
    recordings = simulate_recordings(5, FEW, 1, setup=SimulationSetup(without_faults()))
    for index in range(len(recordings)):
        events = recordings[index]
        order = np.lexsort((events.time_ns, events.taxel))
        gaps = np.diff(events.time_ns[order])[np.diff(events.taxel[order]) == 0]
        # The grid may take a tick, and waiting for another taxel's burst to end five.
        assert gaps.min() >= p.refractory_s * 1e9 - 6 * TICK_NS


def test_gaps_between_events_are_those_of_the_real_recording(recordings):
    # There, a good quarter of the gaps is the blind time itself, and the rest 88 us steps above.
    events = recordings.events
    sample = recordings.sample_of_event
    order = np.lexsort((events.time_ns, events.taxel, sample))
    same = (np.diff(sample[order]) == 0) & (np.diff(events.taxel[order].astype(int)) == 0)
    gaps = np.diff(events.time_ns[order])[same] * 1e-6
    assert 0.1 < np.mean(gaps < 3.30) < 0.5
    steps = (gaps[(gaps > 3.30) & (gaps < 3.7)] - 3.27) / 0.088
    assert np.mean(np.abs(steps - np.round(steps)) < 0.3) > 0.85


def test_a_recording_does_not_depend_on_those_beside_it():
    # The same writer's first 2 and 5, in a batch of their own and among others.
    among = simulate_recordings(1, FEW, jobs=1)
    alone = simulate_recordings(1, [0, 0, 8, 0, 0, 8, 0, 0, 0, 0], jobs=1)
    for name in ("2/0000", "2/0007", "5/0003"):
        one, other = (every[every.ids.index(name)] for every in (among, alone))
        for column in EVENT_DTYPES:
            np.testing.assert_array_equal(getattr(one, column), getattr(other, column))


def bar(digit, writer):
    line = np.column_stack([np.linspace(-0.5, 0.5, 20), np.zeros(20)])
    return Trace(digit, writer, (line if digit else line[:, ::-1],))


def test_recorded_handwriting_is_pressed_on_the_skin():
    traces = (bar(1, 4), bar(1, 9), bar(0, 4))
    setup = SimulationSetup(without_faults(), traces)
    recordings = simulate_recordings(2, [1, 4] + [0] * 8, 1, setup=setup)
    assert sorted(recordings.writers[1:]) == [4, 4, 9, 9]  # both before either comes twice
    lying, upright = recordings[0], recordings[1]
    taxels = recordings.taxels
    assert np.ptp(taxels.column[lying.taxel]) > 4
    rows = [np.average(taxels.row[upright.taxel[part]]) for part in np.array_split(
        np.arange(len(upright)), 3)]  # fmt: skip
    assert rows[0] + 1 < rows[1] < rows[2] - 1  # written downwards
    assert recordings.source.simulated
    assert (
        recordings.source.sha256 != simulate_recordings(2, [1, 4] + [0] * 8, jobs=1).source.sha256
    )
    with pytest.raises(UserError, match=r"\b3\b"):
        simulate_recordings(2, [0, 0, 0, 1] + [0] * 6, setup=setup)
