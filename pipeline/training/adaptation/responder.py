"""The responses of a network at its readout, to which the readout is fitted."""

from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from deploy.network.ops.dense import DeployedDense
from deploy.network.spec import NetworkSpec
from deploy.targets.emulation import Emulation
from pipeline.recordings.augmentation import AUGMENTATIONS, alter_recordings, choose_augmentation
from pipeline.recordings.dataset import make_inputs_for
from pipeline.recordings.recordings import Recordings
from pipeline.settings import Image
from pipeline.training.adaptation.refit import Person

# Number of augmented copies of each sample of a person.
COPIES = 10

# Number of samples that are run in parallel, which limits the memory.
SAMPLES_AT_ONCE = 32


class Responder:
    """A bundle's network up to its readout, on the target ``fast``.

    Parameters
    ----------
    spec : NetworkSpec
    seed : int
    image : Image, optional
        Conversion of events to images, for a network on images whose bundle does not have it.

    Raises
    ------
    UserError
        The readout is on the chip, where it is not a linear function of spikes.
    """

    def __init__(self, spec: NetworkSpec, seed: int = 0, image: Image | None = None):
        readout = spec.layers[-1]
        if readout.neurons is not None or len(spec.layers) < 2:
            raise UserError(
                "the readout is a layer of neurons on the chip; only a readout on the host can be "
                "fitted (deployment.readout = 'host')"
            )
        inputs = readout.weights.shape[1]
        identity = replace(
            readout,
            operation=DeployedDense(inputs),
            block_shape=None,
            weights=np.eye(inputs),
            bias=np.zeros(inputs),
            section_starts=(0,),
        )
        self.spec = spec
        self._emulation = Emulation(
            replace(spec, layers=(*spec.layers[:-1], identity), estimator=None, rehearsal=None),
            seed,
        )
        self._image = image

    @property
    def scale(self) -> float:
        """Factor that converts scores to the logits of the training."""
        presentation = self.spec.presentation
        if self.spec.stimulus.is_static:
            return 1.0
        return float(presentation.steps - presentation.readout_start)

    def make_inputs(self, recordings: Recordings) -> np.ndarray:
        """The inputs of the network for recordings."""
        return make_inputs_for(self.spec, recordings, self._image)

    def run_to_readout(self, samples):
        """The input of the readout at each step.

        Parameters
        ----------
        samples : ndarray, shape (n_samples, ...)
            Inputs of the network; each is presented to a fresh network.

        Yields
        ------
        ndarray, shape (n_batch, steps, inputs)
        """
        gap = self.spec.presentation.gap
        inputs = self.spec.flatten_samples(samples)
        for start in range(0, len(inputs), SAMPLES_AT_ONCE):
            batch = inputs[start : start + SAMPLES_AT_ONCE, None]
            yield self._emulation.run(batch).output[:, 0, gap:]

    def compute_responses(self, samples) -> np.ndarray:
        """Mean input of the readout while it is read.

        Returns
        -------
        ndarray, shape (n_samples, sections * inputs)
            See :class:`deploy.network.rehearsal.Rehearsal`.
        """
        start = self.spec.presentation.readout_start
        readout = self.spec.layers[-1]
        batches = [np.empty((0, readout.weights_by_class.shape[1]))]
        for output in self.run_to_readout(samples):
            output = output[:, start:]
            section = readout.find_section(start + np.arange(output.shape[1]))
            sums = [output[:, section == k].sum(axis=1) for k in range(readout.n_sections)]
            batches.append(np.concatenate(sums, axis=1) / output.shape[1])
        return np.concatenate(batches)

    def make_inputs_in_batches(self, recordings: Recordings):
        """Yield the inputs of the network for a few recordings at a time.

        The inputs on events of 500 recordings of a large sensor need gigabytes.
        """
        for start in range(0, len(recordings), SAMPLES_AT_ONCE):
            indices = np.arange(start, min(start + SAMPLES_AT_ONCE, len(recordings)))
            yield self.make_inputs(recordings.subset(indices))

    def respond_to(self, recordings: Recordings) -> np.ndarray:
        """:meth:`compute_responses` to recordings."""
        batches = self.make_inputs_in_batches(recordings)
        return np.concatenate([self.compute_responses(samples) for samples in batches])

    def respond_to_copies(self, recordings: Recordings, seed) -> np.ndarray:
        """Responses to augmented copies of recordings, shape (n_samples, COPIES, inputs)."""
        n = len(recordings)
        step_ms = 1e3 * self.spec.stimulus.step_seconds
        indices = np.repeat(np.arange(n), COPIES)
        augmentation = AUGMENTATIONS[choose_augmentation(recordings)]
        altered = alter_recordings(recordings, indices, augmentation, step_ms, seed)
        return self.respond_to(altered).reshape(n, COPIES, -1)

    def make_person(self, recordings: Recordings, seed) -> Person:
        """The responses to a person's recordings that a refit needs."""
        responses = self.respond_to(recordings)
        return Person(responses, recordings.labels, self.respond_to_copies(recordings, seed))
