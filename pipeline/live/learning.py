"""Learning the handwriting of the person who writes on the page.

After each labelled digit the readout is fitted again to all labelled digits of this writer
(:mod:`pipeline.training.adaptation`). Each digit is first scored with the previous readout, so that
the page's count of right answers is for digits that were not yet learned. A fit that is not better
in cross-validation is not used. Recordings are never changed.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.files import read_arrays, write_arrays
from pipeline.data.events import Events, Sensor, Source, TaxelMap, collect
from pipeline.live.deciding import Decider, decider_of
from pipeline.settings import Image
from pipeline.training.adaptation import Person, Responder, refit

# Number of the last digits for which the page counts correct answers.
LATEST = 10

# Maximum number of bytes of the data of a writer.
LARGEST = 256 << 20

# Minimum number of digits for fitting a readout, which cross-validation needs.
FEWEST = 2


@dataclass(frozen=True)
class Learnt:
    """The training data and the readout of one writer.

    Attributes
    ----------
    names : tuple of str
        Names of the recordings that were learned from.
    labels : ndarray of int, shape (n,)
    responses : ndarray, shape (n, 1 + copies, parts * inputs)
        Responses to each recording and to augmented copies of it.
    right : ndarray of bool, shape (n,)
        True if the readout was right before it learned from the digit.
    weights : ndarray, shape (classes, parts * inputs), or None
        The writer's own readout; None while it is not better than the bundle's.
    """

    names: tuple = ()
    labels: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    responses: np.ndarray | None = None
    right: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    weights: np.ndarray | None = None

    def __len__(self):
        return len(self.names)

    def with_digit(self, name, label, responses, right) -> Learnt:
        """A copy with another digit."""
        before = self.responses if self.responses is not None else responses[:0][None][:0]
        before = before.reshape(-1, *responses.shape)
        return replace(
            self,
            names=(*self.names, name),
            labels=np.append(self.labels, label),
            responses=np.concatenate([before, responses[None]]),
            right=np.append(self.right, right),
        )

    def without(self, name) -> Learnt:
        """A copy without one of the digits."""
        kept = np.array([other != name for other in self.names], bool)
        return replace(
            self,
            names=tuple(other for other in self.names if other != name),
            labels=self.labels[kept],
            responses=None if self.responses is None else self.responses[kept],
            right=self.right[kept],
        )


class Learner:
    """Readouts of all writers of a folder.

    Parameters
    ----------
    bundle : Bundle
    image : Image
        Conversion of events to images.
    folder : path-like
        Folder of the recordings, where a writer's readout is saved as well.
    sensor : Sensor
    """

    def __init__(self, bundle: Bundle, image: Image, folder, sensor: Sensor):
        self._bundle, self._image, self._folder = bundle, image, Path(folder)
        self._sensor, self._taxels = sensor, TaxelMap.grid(sensor.rows, sensor.columns)
        self._responder = Responder(bundle.spec, image=image)
        self._writers, self._deciders = {}, {}
        self._guard = threading.Lock()

    @classmethod
    def of(cls, bundle: Bundle, image: Image, folder, sensor: Sensor) -> Learner | None:
        """A learner, or None for a bundle whose readout cannot be fitted."""
        if bundle.spec.rehearsal is None or bundle.spec.layers[-1].neurons is not None:
            return None
        return cls(bundle, image, folder, sensor)

    def decider(self, writer: int) -> Decider | None:
        """The network with a writer's readout, or None if it is the bundle's; returns at once."""
        return self._deciders.get(writer)

    def recall(self, writer: int) -> dict:
        """Load the data of a writer, and return the progress of learning."""
        with self._guard:
            if writer not in self._writers:
                self._writers[writer] = self._read(writer)
                self._make_decider(writer)
        return self.state(writer)

    def state(self, writer: int) -> dict:
        """The progress of learning, for the page."""
        known = self._known(writer)
        latest = known.right[-LATEST:]
        return {
            "type": "learned",
            "writer": writer,
            "digits": len(known),
            "right": int(latest.sum()),
            "of": len(latest),
            "own_readout": known.weights is not None,
        }

    def learn(self, writer: int, name: str, label: int, events: Events) -> dict:
        """Score a digit, learn from it, and return the progress of learning.

        Parameters
        ----------
        writer : int
        name : str
            Name of the recording.
        label : int
        events : Events
        """
        source = Source("live", "", True)
        recording = collect([events], [label], [name], [writer], source, self._taxels, self._sensor)
        responder, spec = self._responder, self._bundle.spec
        own = responder.responses_to(recording)
        copies = responder.copies(recording, [writer, len(self._known(writer))])
        responses = np.concatenate([own, copies[0]])
        readout = spec.layers[-1]
        with self._guard:
            known = self._known(writer)
            weights = readout.by_class if known.weights is None else known.weights
            right = int(np.argmax(weights @ own[0] + readout.bias)) == label
            known = known.with_digit(name, label, responses, right)
            self._writers[writer] = self._fitted(known)
            self._keep(writer)
            self._make_decider(writer)
        return self.state(writer)

    def forget(self, writer: int, name: str | None = None) -> dict:
        """Forget one recording of a writer, or all of them."""
        with self._guard:
            known = Learnt() if name is None else self._known(writer).without(name)
            self._writers[writer] = self._fitted(known)
            self._keep(writer)
            self._make_decider(writer)
        return self.state(writer)

    def _fitted(self, known):
        """A copy with a readout that is fitted to all digits."""
        if len(known) < FEWEST:
            return replace(known, weights=None)
        person = Person(known.responses[:, 0], known.labels, known.responses[:, 1:])
        readout = self._bundle.spec.layers[-1]
        kept, scale = self._bundle.spec.rehearsal, self._responder.scale
        fit = refit(readout.by_class, readout.bias, person, kept, 0, scale)
        return replace(known, weights=fit.weights if fit.helps else None)

    def _make_decider(self, writer):
        """The network with the present readout; building it takes Nengo almost a second."""
        weights, spec = self._writers[writer].weights, self._bundle.spec
        if weights is None:
            self._deciders.pop(writer, None)
            return
        readout = spec.layers[-1].with_by_class(weights)
        own = replace(spec, layers=(*spec.layers[:-1], readout))
        self._deciders[writer] = decider_of(
            replace(self._bundle, spec=own), self._image, self._sensor
        )

    def _path(self, writer):
        """A file of its own for each network, so that none replaces what another has learned."""
        return self._folder / f".readout-w{writer:03d}-{self._bundle.id[:12]}.npz"

    def _known(self, writer):
        if writer not in self._writers:
            self._writers[writer] = self._read(writer)
        return self._writers[writer]

    def _read(self, writer):
        return self._digits_in(self._path(writer))

    def _digits_in(self, path):
        """The digits in a file; none if they belong to another network or are damaged."""
        if not path.exists():
            return Learnt()
        try:
            arrays = read_arrays(path, "", LARGEST)
            names, labels, right = arrays["names"], arrays["labels"], arrays["right"]
            responses, weights = arrays["responses"].astype(float), arrays.get("weights")
        except (UserError, KeyError, ValueError):
            return Learnt()
        if str(arrays.get("bundle")) != self._bundle.id:
            return Learnt()
        return Learnt(tuple(names.tolist()), labels, responses, right, weights)

    def _keep(self, writer):
        """Write the data of a writer, if there are any."""
        known = self._writers[writer]
        if not len(known):
            self._path(writer).unlink(missing_ok=True)
            return
        own = {} if known.weights is None else {"weights": known.weights}
        write_arrays(
            self._path(writer),
            bundle=np.array(self._bundle.id),
            names=np.array(known.names, str),
            labels=np.asarray(known.labels, np.int64),
            responses=known.responses.astype(np.float32),
            right=np.asarray(known.right, bool),
            **own,
        )
