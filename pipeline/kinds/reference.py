"""The stages of the ladder before the bundle, with which those of the targets are compared."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.responses import Responses
from pipeline.kinds.steps import StepInputs


class Reference(NamedTuple):
    """A stage of the ladder before the bundle, with which those of the targets are compared.

    Attributes
    ----------
    title : str
    note : str
        What it is, in a few words.
    step : str
        Name of the step whose artifact predicts.
    compute_logits : callable
        ``compute_logits(stage, inputs, samples, advance)``: ndarray, shape (n_samples, steps,
        classes), with one step for a network without time.  ``inputs`` is a
        :class:`pipeline.kinds.steps.StepInputs`, ``samples`` a
        :class:`deploy.check.bundle.CheckSet`, and ``advance``, if it is not None, is called with
        the number of samples done since the last call.
    list_versions : callable
        Versions of the packages that compute it.
    respond : callable, optional
        ``respond(inputs, bundle, advance)``: the responses to the samples of a bundle, as
        :class:`deploy.network.responses.Responses`.  Default: computed from the logits.
    """

    title: str
    note: str
    step: str
    compute_logits: Callable
    list_versions: Callable
    respond: Callable | None = None

    def respond_to(self, stage: str, inputs: StepInputs, bundle: Bundle, advance=None) -> Responses:
        """The responses of a stage to the samples of a bundle."""
        if self.respond is not None:
            return self.respond(inputs, bundle, advance)
        logits = self.compute_logits(stage, inputs, bundle.checks, advance)
        return make_responses_of_logits(logits, bundle.spec.presentation)


def make_responses_of_logits(logits: np.ndarray, presentation) -> Responses:
    """Compute scores and decisions from logits.

    Parameters
    ----------
    logits : ndarray, shape (n_samples, steps, classes)
        Logits at each step; one step for a network without time.
    presentation : pipeline.settings.groups.PresentationSettings
        In networks with time, the score at a step is the mean from ``readout_start`` to it.
    """
    start = presentation.readout_start if logits.shape[1] > 1 else 0
    window = logits[:, start:]
    scores = np.cumsum(window, axis=1) / np.arange(1, window.shape[1] + 1)[:, None]
    decisions = np.full(logits.shape[:2], -1)
    decisions[:, start:] = np.argmax(scores, axis=2)
    return Responses(scores[:, -1], decisions, {}, {})
