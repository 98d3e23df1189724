"""A network that the user has trained elsewhere, as settings of a run.

The command ``convert`` and :meth:`pipeline.api.run.Run.convert` make the same
:class:`ImportRequest`.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from deploy.errors import UserError
from pipeline.kinds.image.keras_model import make_model_settings
from pipeline.kinds.image.kind import make_kept_image_settings
from pipeline.kinds.nir.importing import make_nir_settings, require_convertible_graph
from pipeline.kinds.registry import find_kind
from pipeline.settings import Settings
from pipeline.storage.run_folder import RunFolder


@dataclass(frozen=True)
class ImportRequest:
    """The file of a network, and how it is imported.

    Attributes
    ----------
    model : path-like, optional
        A Keras model that replaces the CNN.
    nir : path-like, optional
        A NIR graph that replaces all training.
    step_ms : float, optional
        With ``nir``: milliseconds of the recording in a step of the network.
    retrain : bool
        With ``model``: train it further with rate-LIF neurons.
    strict : bool
        With ``nir``: refuse a graph that was trained with another reset than the chip's.
    prefix : str
        Stands before the names of these values in messages, such as ``"--"``.

    Raises
    ------
    UserError
        Both networks are given, or a value that belongs to the other one or to none.
    """

    model: str | PathLike | None = None
    nir: str | PathLike | None = None
    step_ms: float | None = None
    retrain: bool = False
    strict: bool = False
    prefix: str = ""

    def __post_init__(self):
        model = f"{self.prefix}model"
        nir = f"{self.prefix}nir"
        if self.retrain and self.model is None:
            raise UserError(f"{self.prefix}retrain: needs a Keras model; give it with {model}")
        if self.model is not None and self.nir is not None:
            raise UserError(f"{model} and {nir}: a run has one network; give only one of them")
        if self.step_ms is not None and self.nir is None:
            raise UserError(f"{self.prefix}step: needs a NIR graph; give it with {nir}")
        if self.strict and self.nir is None:
            raise UserError(f"{self.prefix}strict: needs a NIR graph; give it with {nir}")

    def make_settings(
        self, before: Settings, input_kind: str | None, run: RunFolder | None = None
    ) -> dict:
        """Changes of a run's settings that import the network; none without a network.

        Parameters
        ----------
        before : Settings
            The settings of the run before.
        input_kind : str, optional
            The input that the user asks for.
        run : RunFolder, optional
            A Keras model gets the images that this run has, if it exists.
        """
        if self.model is not None:
            changes = make_model_settings(Path(self.model), self.retrain, before)
            kept = {} if run is None else make_kept_image_settings(run)
            return changes | kept
        if self.nir is not None:
            return make_nir_settings(self.nir, self.step_ms, input_kind, before)
        return {}

    def require_convertible(self, settings: Settings):
        """Refuse a network that fits no recordings, before they are loaded.

        Parameters
        ----------
        settings : Settings
            All settings, with those of :meth:`make_settings`.
        """
        if self.model is not None and find_kind(settings).imported is None:
            raise UserError(
                f"{self.prefix}model: Keras models receive tactile images; leave out the input of "
                "events"
            )
        if self.nir is not None:
            require_convertible_graph(settings, self.strict)
