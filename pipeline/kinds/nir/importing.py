"""Import a NIR graph as the network of a run: its settings, a copy of it, and requirements."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from deploy.errors import UserError
from deploy.files import hash_file
from deploy.network.chip import LOIHI
from models.nir.chain import from_nir
from models.nir.graph import NirNetwork, read_nir
from models.rounding import round_to_integers
from pipeline.kinds.architectures import suggest_sensor_size
from pipeline.kinds.imported import find_imported_file, is_file
from pipeline.recordings.dataset import Dataset
from pipeline.settings import Settings
from pipeline.storage.run_folder import DELETE_ITS_FOLDER

# The run's copy of the graph, in the folder of its network.
GRAPH = "network.nir"

# The remedy for a graph that has changed since it was imported.
GIVE_AGAIN = "give it again with 'stmnist convert RUN --nir FILE'"


@dataclass(frozen=True)
class Stepping:
    """How a graph is run: the chip's steps in the graph's time, the equations, the reset.

    Attributes
    ----------
    step_s : float
        Seconds of the graph's time in a step.
    method : str
        One of :data:`models.nir.equations.METHODS`.
    reset : str
        One of :data:`models.nir.simulator.RESETS`, with which the graph was trained.
    """

    step_s: float
    method: str
    reset: str = "value"

    @classmethod
    def from_settings(cls, settings: Settings, network: NirNetwork) -> Stepping:
        """The values of the settings, or those of the graph's convention where they have none."""
        nir = settings.nir
        convention = network.convention
        step_s = settings.input.step_ms / 1000 if settings.on_events else LOIHI.dt
        if nir.step_ms:
            step_s = nir.step_ms / 1000
        elif convention.step_s is not None:
            step_s = convention.step_s
        method = convention.method if nir.method == "auto" else nir.method
        reset = convention.reset if nir.reset == "auto" else nir.reset
        return cls(step_s, method, reset)


def read_copy_of_graph(folder: Path, settings: Settings) -> NirNetwork:
    """The run's copy of the graph, in the folder of its network.

    Raises
    ------
    UserError
        The file cannot be read, or is not the graph that was imported.
    """
    path = folder / GRAPH
    network = read_nir(path)
    if hash_file(path) != settings.nir.sha256:
        raise UserError(f"{path}: has changed since it was imported; {DELETE_ITS_FOLDER}")
    return network


def make_nir_settings(
    path, step_ms: float | None = None, kind: str | None = None, before: Settings | None = None
) -> dict:
    """Changes of the settings with which a NIR graph replaces the trained network.

    Parameters
    ----------
    path : path-like
    step_ms : float, optional
        Milliseconds of the recording in a step of the chip; of events only.
    kind : str, optional
        ``"image"`` or ``"events"``; default: from the number of channels of the graph's input, two
        for events and one for images.
    before : Settings, optional
        The run's present settings.  If they are of the same file, which may have changed, and have
        the same kind of input, ``nir.step`` is kept.

    Raises
    ------
    UserError
        The file cannot be read, is not a NIR graph, or cannot be used.
    """
    path = Path(path)
    before = before or Settings()
    network = read_nir(path)
    sha256 = hash_file(path)
    nir = {"file": str(path.absolute()), "sha256": sha256}
    is_known = before.nir.sha256 == sha256
    was_graph = is_known or before.nir.file == nir["file"]
    if kind is None:
        shape = network.input_shape
        is_image = before.input.kind != "events" and shape[0] == before.image.channels
        is_known |= was_graph and (len(shape) == 1 or is_image)
        kind = before.input.kind if is_known else _find_input_kind(path, shape)
    changes = {"input": {"kind": kind}, "nir": nir}
    if not (was_graph and before.input.kind == kind):
        nir["step"] = 0.0
    if step_ms is not None and kind == "events":  # images have no step of the recording
        changes["input"]["step"] = step_ms
    return changes


def _find_input_kind(path, shape):
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
        f"{path}: an input of {' x '.join(map(str, shape))}; events have two channels (ON, OFF), "
        "an image of counts one; others need --input image and, for example, --set image.slices=4"
    )


def find_graph(folder: Path, settings: Settings, dataset: Dataset) -> tuple:
    """The graph that was imported, from the user's file or else from the run's copy.

    Parameters
    ----------
    folder : Path
        Folder of the copy.
    settings, dataset

    Returns
    -------
    Path, NirNetwork

    Raises
    ------
    UserError
        The file has changed or cannot be read, and the run has no copy; or the graph is for another
        sensor or other classes.
    """
    source = find_imported_file(settings.nir.file, settings.nir.sha256, folder / GRAPH)
    network = read_nir(source)
    if not is_file(source, settings.nir.sha256):
        raise UserError(f"{source}: has changed; {GIVE_AGAIN}")
    classes = len(dataset.recordings.sensor.classes)
    require_graph_fits(network, find_input_shape(dataset), classes, source, settings.on_events)
    return source, network


def require_convertible_graph(settings: Settings, strict: bool = False):
    """Refuse a graph that cannot fit any recordings, before anything is written.

    Parameters
    ----------
    settings : Settings
        With ``nir.file``.
    strict : bool
        Also refuse a graph that was trained with another reset than the chip's.

    Raises
    ------
    UserError
        The message names the file, the node or nodes of a layer, and an alternative.
    """
    source = settings.nir.file
    network = read_nir(source)
    stepping = Stepping.from_settings(settings, network)
    if strict and stepping.reset != "value":
        raise UserError(
            f"{source}: trained with a reset by subtraction ('nir.reset'), and the chip resets to "
            "v_reset; train it with a reset to zero, or convert it without --strict"
        )
    try:
        first, *others = from_nir(network, stepping.step_s, stepping.method)
        height = settings.stimulus.area / LOIHI.dt
        for layer in (replace(first, kernel=first.kernel * height), *others):
            if layer.neurons is not None:
                round_to_integers(layer)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


def require_graph_fits(network: NirNetwork, fed_shape, n_classes: int, source, on_events: bool):
    """Refuse a graph for another sensor or other classes.

    Parameters
    ----------
    network : NirNetwork
    fed_shape : tuple of int
        (rows, columns, channels) of the input in this run.
    n_classes : int
    source : path-like
    on_events : bool
        Both polarities of events may be one channel of the graph.

    Raises
    ------
    UserError
        The message has the required sensor and classes.
    """
    rows, columns, channels = fed_shape
    shape = network.input_shape
    fits = [(n, rows, columns) for n in ({channels, 1} if on_events else {channels})]
    if shape not in (*fits, *((math.prod(fit),) for fit in fits)):
        input_name = "events" if on_events else "an image"
        remedy = suggest_sensor_size(shape[1:], (rows, columns)) if len(shape) == 3 else ""
        raise UserError(
            f"{source}: has an input of {' x '.join(map(str, shape))}; {input_name} of {rows} x "
            f"{columns} taxels would be {channels} x {rows} x {columns} (channels, rows, columns): "
            f"{remedy}train it for that, or give another --data or --input, or other settings "
            "image.*"
        )
    if network.outputs != n_classes:
        raise UserError(
            f"{source}: {network.nodes[-1]} outputs {network.outputs} values, and there are "
            f"{n_classes} classes: train it for those, or give other recordings (--data)"
        )


def find_input_shape(dataset) -> tuple:
    """(rows, columns, channels) of the inputs of a run's networks."""
    return dataset.inputs.shape[-3:]
