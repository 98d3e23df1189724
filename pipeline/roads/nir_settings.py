"""Settings for a NIR graph that is the network of a run: kind of input, steps, presentation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from deploy.errors import UserError
from deploy.files import sha256_of
from deploy.network.chip import LOIHI
from models.nir_graph import NirNetwork, read_nir
from pipeline.run import DELETE_ITS_FOLDER
from pipeline.settings import Settings

GRAPH = "network.nir"
"""The run's copy of the graph, in the folder of its network."""

FROM_REST = {"gap": 0, "stream_length": 1}
"""Default presentation of samples to an imported network: each from rest.  Trainings in PyTorch
start every sample with the neurons' state at rest (``reset_hidden`` of snnTorch, a state of None in
Norse), so that this is what the network was trained for.  A board loads the network at the start of
each stream, so that it is then loaded for each sample."""


@dataclass(frozen=True)
class Stepped:
    """Division of a graph's time into the chip's steps.

    Attributes
    ----------
    seconds : float
        Seconds of the graph's time per step.
    method : str
        One of :data:`models.nir_simulator.METHODS`.
    """

    seconds: float
    method: str

    @classmethod
    def of(cls, settings: Settings, network: NirNetwork) -> Stepped:
        """The values of the settings, or those of the graph where the settings have none."""
        nir, by_snntorch = settings.nir, network.written_by_snntorch
        seconds = settings.input.step / 1000 if settings.on_events else LOIHI.dt
        if nir.step:
            seconds = nir.step / 1000
        elif network.step is not None:
            seconds = network.step
        method = nir.method
        if method == "auto":
            method = "euler" if by_snntorch else "exact"
        return cls(seconds, method)

    def __str__(self):
        how = "Euler steps" if self.method == "euler" else "exact steps"
        return f"{how} of {1000 * self.seconds:g} ms of the graph's time"


def settings_of_nir(
    path,
    step: float | None = None,
    kind: str | None = None,
    before: Settings | None = None,
) -> dict:
    """Changes of the settings with which a NIR graph replaces the trained network.

    Parameters
    ----------
    path : path-like
    step : float, optional
        Milliseconds that a step of the chip represents.
    kind : str, optional
        ``"image"`` or ``"events"``; default: from the number of channels of the graph's input, two
        for events and one for images.
    before : Settings, optional
        The run's present settings.  If they are of the same file, which may have changed, and have
        the same kind of input, their presentation and steps are kept.

    Raises
    ------
    UserError
        The file cannot be read, is not a NIR graph, or cannot be used.
    """
    path, before = Path(path), before or Settings()
    network, sha256 = read_nir(path), sha256_of(path)
    nir = {"file": str(path.absolute()), "sha256": sha256}
    is_known = before.nir.sha256 == sha256
    was_graph = is_known or before.nir.file == nir["file"]
    if kind is None:
        is_known = is_known or (was_graph and len(network.input_shape) == 1)
        kind = before.input.kind if is_known else _kind_of(path, network.input_shape)
    changes = {"input": {"kind": kind}, "nir": nir}
    if not (was_graph and before.input.kind == kind):
        changes["input"]["refractory"] = nir["step"] = 0.0
        changes["presentation"] = FROM_REST
    if step is not None:
        changes["input" if kind == "events" else "nir"]["step"] = step
    return changes


def give_again(settings: Settings) -> str:
    """The remedy for a graph that has changed since it was imported."""
    return "give it again with 'stmnist convert RUN --nir FILE'"


def graph_in(folder: Path, settings: Settings) -> NirNetwork:
    """The run's copy of the graph, in the folder of its network.

    Raises
    ------
    UserError
        The file cannot be read, or is not the graph that was imported.
    """
    path = folder / GRAPH
    network = read_nir(path)
    if sha256_of(path) != settings.nir.sha256:
        raise UserError(f"{path}: has changed since it was imported; {DELETE_ITS_FOLDER}")
    return network


def _kind_of(path, shape):
    """The kind of input for this shape."""
    if len(shape) == 3 and shape[0] in (1, 2):
        return "image" if shape[0] == 1 else "events"
    if len(shape) == 1:
        for channels, kind in ((2, "events"), (1, "image")):
            side = math.isqrt(shape[0] // channels)
            if shape[0] == channels * side * side:
                return kind
        raise UserError(
            f"{path}: {shape[0]} inputs are neither a square array of taxels nor two of them; "
            "give its input with --input events or --input image"
        )
    raise UserError(
        f"{path}: an input of {' x '.join(map(str, shape))}; the skin has two channels of events "
        "(ON, OFF) or one of an image, (channels, rows, columns): train the network for those"
    )
