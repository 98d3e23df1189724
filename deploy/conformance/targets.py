"""Checks that every target must pass."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Dict, Optional, Tuple

import numpy as np

from ..errors import UserError
from ..network.readout import select_readout
from ..network.reference import make_input_spikes, run_reference
from ..network.responses import make_responses
from ..network.spec import NetworkSpec
from ..network.stimulus import ImageSpikes
from ..targets.options import Options
from ..targets.registry import REAL_NUMBERS, Target, find_target, run_target
from .networks import (
    LONG_PRESENTATION,
    draw_busy_frames,
    draw_frames,
    draw_images,
    make_busy_event_network,
    make_busy_image_network,
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


def assert_target_conforms(target: Target, options: Optional[Options] = None):
    """Find the usual mistakes of a target; each is an error that names the mistake.

    The target is tried on images, on events, with output neurons, with a readout in sections and
    with recurrent neurons.  These are the mistakes: outputs of wrong shapes and types, samples or
    streams that disturb each other, and outputs that are not those of the network: if the target is
    exact, those of the chip's emulator, otherwise those of
    :func:`deploy.network.reference.run_reference`, up to the target's ``tolerance``.  A target with
    ``refuses_unfit_itself`` must refuse a network that the chip's integers cannot hold.

    Parameters
    ----------
    target : Target
        It need not be registered.
    options : Options, optional
        Options with which it computes the network, such as noise of 0; by default its defaults.

    Raises
    ------
    AssertionError, ValueError
    """
    tried = _Tried(target, _choose_options(target, options))
    if target.refuses_unfit_itself:
        _assert_refusal(tried)
    _assert_forms(tried)
    for title, (spec, samples) in make_busy_networks().items():
        _assert_values(tried, title, spec, samples)


def assert_output_forms(target: Target, options: Optional[Options] = None):
    """Find the mistakes of :func:`assert_target_conforms` in shapes, types and streams only.

    Parameters
    ----------
    target, options
        As for :func:`assert_target_conforms`.
    """
    _assert_forms(_Tried(target, _choose_options(target, options)))


def _choose_options(target, options):
    """The given options, or else the target's defaults."""
    return target.options() if options is None and target.options is not None else options


def make_unfit_network() -> NetworkSpec:
    """A network that the chip's integers cannot hold: its input weights need 17 bits."""
    return replace(make_image_network(), stimulus=ImageSpikes(max_rate=1e-3))


def _assert_refusal(tried):
    """Require an error for a network that the chip's integers cannot hold."""
    spec = make_unfit_network()
    stream = spec.flatten_samples(draw_images(spec, 1, np.random.default_rng(0)))
    try:
        list(tried.run(spec, [stream]))
    except UserError:
        return
    raise AssertionError(
        "the target runs a network that the chip's integers cannot hold; leave out "
        "refuses_unfit_itself"
    )


def _assert_forms(tried):
    """Require outputs of the right shapes on networks of all forms."""
    for title, (spec, samples) in make_small_networks().items():
        with _naming(f"{title} of {spec.presentation.steps} steps"):
            _assert_streams(tried, spec, samples)


@contextmanager
def _naming(title):
    """Put a title before the message of an error that is raised in the block."""
    try:
        yield
    except AssertionError as error:
        raise AssertionError(f"{title}: {error}") from error
    except Exception as error:
        raise ValueError(f"{title}: {type(error).__name__}: {error}") from error


def make_small_networks() -> Dict[str, Tuple[NetworkSpec, np.ndarray]]:
    """Networks of all forms for several streams of a few samples, by their titles."""
    images = make_image_network(stream_length=3)
    on_chip = make_image_network(on_chip_output=True, stream_length=2)
    events = make_event_network(stream_length=2)
    output = make_readout((5,), np.random.default_rng(0), classes=3, section_starts=(0, 12))
    in_sections = replace(events, layers=(*events.layers[:2], output))
    return {
        "a small network on images": (images, draw_images(images, 5, np.random.default_rng(0))),
        "a small network with output neurons": (
            on_chip,
            draw_images(on_chip, 3, np.random.default_rng(0)),
        ),
        "a small network on events": (events, draw_frames(events, 3)),
        "a small network with a readout in sections": (in_sections, draw_frames(in_sections, 3)),
    }


def make_busy_networks() -> Dict[str, Tuple[NetworkSpec, np.ndarray]]:
    """Networks whose outputs are compared, with a stream of samples of each, by their titles."""
    on_images = {
        "a network on images": make_busy_image_network(),
        "a network with output neurons": make_busy_image_network(on_chip_output=True),
    }
    on_events = {
        "a network on events": make_busy_event_network(),
        "a network with a readout in sections": make_busy_event_network(section_starts=(0, 60)),
        "a network with recurrent neurons": make_busy_event_network(inhibition=4.0),
    }
    rng = np.random.default_rng(0)
    length = LONG_PRESENTATION["stream_length"]
    return {
        **{title: (spec, draw_images(spec, length, rng)) for title, spec in on_images.items()},
        **{title: (spec, draw_busy_frames(spec, length)) for title, spec in on_events.items()},
    }


def _assert_values(tried, title, spec, samples):
    """Compare the outputs on a network with those that they should be.

    An exact target must equal the emulator; any other must be within its tolerance of the
    equations.
    """
    stream = spec.flatten_samples(samples)
    run_expected = find_target("fast").run if tried.target.is_exact else run_reference
    tolerance = REAL_NUMBERS if tried.target.is_exact else tried.target.tolerance
    (expected,) = run_expected(spec, [stream], 0, None)
    (result,) = tried.run(spec, [stream])
    found, right = (_select_values(spec, output.readout) for output in (result, expected))
    of_samples = _Comparison(found.sum(1), right.sum(1), ("sample", "class"))
    of_quarters = _Comparison(
        *(_sum_quarters(values) for values in (found, right)), ("quarter of the steps", "class")
    )
    for comparison in (of_samples, of_quarters):
        comparison.require(f"{title}: the readout", tolerance)
    for name, spikes in (result.spikes or {}).items():
        counts = _Comparison(spikes.sum(0), expected.spikes[name].sum(0), ("neuron",))
        counts.require(f"{title}: the number of spikes of {name!r}", tolerance)
    if tried.target.is_exact:
        np.testing.assert_array_equal(
            result.spike_hashes,
            expected.spike_hashes,
            f"{title}: spikes differ from the emulator's",
        )


def _select_values(spec, readout):
    """The readout of the classes at each step, shape (n_samples, steps, classes)."""
    values = np.asarray(readout)
    has_only_classes = values.shape[-1] == spec.layers[-1].size
    return values if has_only_classes else select_readout(spec, values)


def _sum_quarters(values):
    """The readout of all samples, summed over quarters of the presentation, (4, classes)."""
    return np.stack([part.sum((0, 1)) for part in np.array_split(values, 4, axis=1)])


@dataclass(frozen=True)
class _Comparison:
    """Values of a target and those that they should be, with the names of their axes.

    Single spikes at other times hardly change them, nor does a delay of a few steps: they are sums
    over many steps.  They cannot be compared step by step, since the readout of a rounded network
    differs from the equations at each step by as much as that of a delayed one.
    """

    found: np.ndarray
    right: np.ndarray
    axes: Tuple[str, ...]

    def require(self, title, tolerance):
        """Refuse values whose differences, relative to the values, are above the tolerance.

        Differences and values are each summarised by their root mean square.
        """
        differences = self.found - self.right.astype(float)
        error = np.linalg.norm(differences) / np.linalg.norm(self.right)
        worst = np.unravel_index(np.argmax(np.abs(differences)), differences.shape)
        place = ", ".join(f"{axis} {index}" for axis, index in zip(self.axes, worst))
        assert error <= tolerance, (
            f"{title} differs by {error:.3g} of its size, more than the tolerance {tolerance:g} of "
            f"the target; most at {place}: {self.found[worst]:.4g}, not {self.right[worst]:.4g}"
        )


def _assert_streams(tried, spec, samples):
    """Require output of the right shapes, and streams that begin with a fresh network."""
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
