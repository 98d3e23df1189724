"""What the network makes of the events so far.

A :class:`Decider` is made once of a bundle and answers for all pages; what one recording needs
between two answers stands in what :meth:`Decider.begin` gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.responses import read_output
from deploy.targets.fast.emulation import Emulation, compile_spec
from pipeline.inputs.images import tactile_images
from pipeline.recordings.events import Events, Source, collect
from pipeline.settings import Image


@dataclass(frozen=True)
class Answer:
    """What the network says at a moment.

    Attributes
    ----------
    scores : ndarray of float, shape (10,)
    confidence : ndarray of float, shape (10,)
        The same as probabilities (softmax), as the network was trained to read them.
    spikes : dict of str to ndarray of uint8, shape (steps, n_bytes)
        Spikes of each layer at each step of the network's time, eight neurons a byte
        (`numpy.packbits`).
    """

    scores: np.ndarray
    confidence: np.ndarray
    spikes: dict

    @property
    def decision(self) -> int:
        """The digit with the highest score."""
        return int(np.argmax(np.round(self.scores, 9)))


@dataclass(frozen=True)
class Layer:
    """A layer as the page draws it."""

    name: str
    neurons: int


class Deciding(Protocol):
    """One recording's side of a decider."""

    def answer(self, events: Events, time_s: float) -> Answer | None:
        """Answer to all events of a recording up to a time, which never goes back; may be slow."""


class Decider(Protocol):
    """A network that has been made ready.

    Attributes
    ----------
    about : str
        One sentence for the page: what the network is shown.
    layers : tuple of Layer
        Those that spike, in order.
    steps : int
        Of the network's time in an answer's spikes.
    first_step : int
        The first one's number; below 0 where the network rests before it is shown anything.
    """

    about: str
    layers: tuple
    steps: int
    first_step: int

    def begin(self) -> Deciding:
        """A recording begins."""


class ImageDecider:
    """A bundle whose input is the tactile image: shown the image so far, from rest, every time.

    Making one takes a few seconds, and some ten the first time ever, when the kernel is compiled;
    then every answer takes a millisecond or so.

    Parameters
    ----------
    bundle : Bundle
    image : Image
        How events become an image.
    seed : int
    """

    def __init__(self, bundle: Bundle, image: Image, seed: int = 0):
        self._spec, self._image = bundle.spec, image
        self._emulation = Emulation(compile_spec(bundle.spec, seed))
        shown = bundle.spec.presentation
        self.steps, self.first_step = shown.period, -shown.gap
        self.about = (
            f"The network is shown the image as it is at this moment for {shown.steps} steps of "
            "1 ms, from rest, again and again while you write."
        )
        answer = self._show(np.zeros((1, 1, int(np.prod(bundle.spec.input_shape)))))
        self._n_bytes = {name: rows.shape[1] for name, rows in answer.spikes.items()}
        sizes = {layer.name: layer.size for layer in bundle.spec.layers}
        sizes["input"] = int(np.prod(bundle.spec.input_shape))
        self.layers = tuple(Layer(name, sizes[name]) for name in bundle.spec.spiking_layers)

    def begin(self):
        """Nothing is kept from one answer to the next."""
        return self

    def answer(self, events: Events, time_s: float) -> Answer | None:
        """See :class:`Deciding`."""
        if len(events) == 0:
            return None
        alone = collect([events], [0], [""], [-1], Source("live", "", True))
        image = tactile_images(alone, self._image.aggregation, self._image.normalisation)
        return self._show(image.reshape(1, 1, -1))

    def _show(self, images):
        spec, spikes = self._spec, {}
        shown = spec.presentation

        def watch(packed):
            spikes.update({name: packed[name][0] for name in spec.spiking_layers})

        done = self._emulation.run(images, shown.steps, shown.gap, watch)
        counts = {name: done.counts[name][0] for name in spec.spiking_layers}
        scores = read_output(spec, done.output[0, :, shown.gap :], counts).scores[0]
        odds = np.exp(scores - scores.max())
        return Answer(scores, odds / odds.sum(), spikes)


def decider_of(bundle: Bundle, image: Image) -> Decider:
    """The decider for a bundle; compiles what has to be compiled."""
    return ImageDecider(bundle, image)
