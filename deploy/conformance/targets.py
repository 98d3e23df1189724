"""Checks that every target must pass."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Optional

import numpy as np

from ..network.reference import make_input_spikes, run_reference
from ..network.responses import make_responses
from ..targets.options import Options
from ..targets.registry import Target, find_target, run_target
from .networks import (
    draw_frames,
    draw_images,
    make_event_network,
    make_image_network,
    make_readout,
)


@dataclass(frozen=True)
class _Tried:
    """A target with the options with which it is tried."""

    target: Target
    options: Optional[Options]

    def run(self, spec, streams):
        return self.target.run(spec, streams, 0, self.options)


def assert_target_conforms(
    target: Target, computes_network: bool = True, options: Optional[Options] = None
):
    """Find the usual mistakes of a target; each is an error that names the mistake.

    The target is tried on images, on events, and on a readout in sections.  These are the mistakes:
    outputs of wrong shapes and types, samples or streams that disturb each other, and outputs that
    are not those of the network.

    Parameters
    ----------
    target : Target
        It need not be registered.
    computes_network : bool
        True if its readout and spikes must be those of the network: if the target is exact, those
        of the chip's emulator, otherwise about those of
        :func:`deploy.network.reference.run_reference`.
    options : Options, optional
        Options with which it computes the network, such as noise of 0; by default its defaults.

    Raises
    ------
    AssertionError, ValueError
    """
    if options is None and target.options is not None:
        options = target.options()
    tried = _Tried(target, options)
    images = make_image_network(stream_length=3)
    samples = draw_images(images, 5, np.random.default_rng(0))
    _assert_streams(tried, images, samples)
    if computes_network:
        _assert_values(tried, images, samples)
    on_chip = make_image_network(on_chip_output=True, stream_length=2)
    _assert_streams(tried, on_chip, draw_images(on_chip, 3, np.random.default_rng(0)))
    events = make_event_network(stream_length=2)
    output = make_readout((5,), np.random.default_rng(0), classes=3, section_starts=(0, 12))
    for spec in (events, replace(events, layers=(*events.layers[:2], output))):
        _assert_streams(tried, spec, draw_frames(spec, 3))


def _assert_values(tried, spec, samples):
    """Its outputs are those of the chip's integers, or about those of the equations."""
    stream = spec.flatten_samples(samples)[: spec.presentation.stream_length]
    run_expected = find_target("fast").run if tried.target.is_exact else run_reference
    (expected,) = run_expected(spec, [stream], 0, None)
    (result,) = tried.run(spec, [stream])
    actual = _sum_tenths(result.readout)
    reference = _sum_tenths(expected.readout)
    error = np.abs(actual - reference).max() / np.abs(reference).max()
    assert error < 0.1, f"the readout differs by {error:.0%} from the expected one"
    for name, spikes in (result.spikes or {}).items():
        total = np.sum(expected.spikes[name])
        difference = abs(np.sum(spikes) - total) / total
        assert difference < 0.1, f"{name} has {difference:.0%} more or fewer spikes"


def _sum_tenths(readout):
    """The readout summed over tenths of the presentation, shape (n_samples, 10, classes)."""
    return np.stack([part.sum(1) for part in np.array_split(readout, 10, axis=1)], axis=1)


def _assert_streams(tried, spec, samples):
    """Its output has the right shapes, and a stream begins with a fresh network."""
    flat = spec.flatten_samples(samples)
    streams = [flat[stream] for stream in spec.presentation.list_streams(len(flat))]
    outputs = list(tried.run(spec, streams))
    assert len(outputs) == len(streams), f"{len(outputs)} outputs of {len(streams)} streams"
    for output, stream in zip(outputs, streams):
        make_responses(spec, output, len(stream), tried.target.name)
    (alone,) = tried.run(spec, streams[-1:])
    np.testing.assert_array_equal(
        alone.readout, outputs[-1].readout, "a stream depends on the streams before it"
    )
    (first,) = tried.run(spec, [streams[0][:1]])
    np.testing.assert_array_equal(
        first.readout[0], outputs[0].readout[0], "a sample depends on the samples after it"
    )
    if outputs[0].spikes is not None:
        sent = make_input_spikes(spec, streams[0]).reshape(len(streams[0]), -1, flat.shape[-1])
        np.testing.assert_array_equal(
            outputs[0].spikes["input"], sent.sum(1), "the input neurons spike at other times"
        )
    if tried.target.is_exact:
        expected = run_target(spec, samples, "fast").spike_hashes
        result = np.concatenate([output.spike_hashes for output in outputs])
        np.testing.assert_array_equal(result, expected, "spikes differ from the emulator's")
