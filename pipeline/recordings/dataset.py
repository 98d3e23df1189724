"""Data sets for networks: the input and label of each recording, and the split."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from deploy.errors import UserError
from deploy.network.provenance import TRAINING_RECORDINGS
from deploy.network.spec import NetworkSpec
from deploy.terminal import WARNING
from pipeline.recordings.cache import make_empty_array
from pipeline.recordings.images import AlteredImages, make_tactile_images
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.spike_frames import RECORDINGS_AT_ONCE, EventTable, SpikeLimits
from pipeline.recordings.splits import PUBLISHED, Split, find_split_problem, make_split
from pipeline.settings import SIMULATED, Image, Settings
from pipeline.storage.artifacts import Origin

# Recordings whose frames of events are made at once, which bounds the memory.
MAX_RECORDINGS_AT_ONCE = 500

# Maximum size of one array of the frames of all samples; larger ones are made when needed.
MAX_FRAME_BYTES = 1 << 29

# Share of merged events above which a shorter step is suggested.
MAX_MERGED_EVENT_SHARE = 0.1

# Remedy for too few samples for the check.
TOO_SMALL = "ask for fewer (--samples, or check.samples) or give more data"

# Remedy for too few samples for the split.
NO_SPLIT = "give other data, or another split.kind or split.test_fraction"

# Version of the rules by which files become recordings. Increase it when they change: the hash of
# the files does not.
READING_RULES_VERSION = "4"


@dataclass(frozen=True)
class Dataset:
    """Recordings, their split and the inputs of networks made from them.

    Attributes
    ----------
    recordings : Recordings
    split : Split
    origin : Origin
        Origin of the recordings and of their split.
    settings : Settings
        Settings with which :attr:`inputs` are made; see :meth:`restrict_to`.
    """

    recordings: Recordings
    split: Split
    origin: Origin
    settings: Settings
    _made: dict = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self):
        parts = ("train", "validation", "test")
        sizes = ", ".join(f"{len(getattr(self.split, part))} {part}" for part in parts)
        return f"Dataset({self.recordings!r}: {sizes})"

    @classmethod
    def from_recordings(
        cls,
        settings: Settings,
        recordings: Recordings,
        split: Split | None = None,
    ) -> Dataset:
        """The recordings that the settings name, split with the seed of the settings.

        Parameters
        ----------
        settings : Settings
        recordings : Recordings
            From :func:`pipeline.sources.load_named_recordings`.
        split : Split, optional
            From :func:`split_recordings`, if they were split before.

        Raises
        ------
        UserError
            They are too few for the split, or there is a class with a single recording.
        """
        if split is None:
            split = split_recordings(recordings, settings)
            if problem := find_split_problem(recordings, split.kind):
                raise UserError(f"{settings.data.source}: {problem}")
        origin = make_dataset_origin(settings, recordings.source.sha256, split.kind)
        return cls(recordings, split, origin, settings)

    def __len__(self):
        return len(self.recordings)

    @property
    def inputs(self) -> np.ndarray:
        """The inputs made from each recording; see :func:`make_inputs`."""
        key = _read_presentation_settings(self.settings)
        if key not in self._made:
            self._made.clear()  # frames of events take a quarter of a gigabyte
            self._made[key] = make_inputs(self.recordings, self.settings)
        return self._made[key]

    @property
    def provenance(self) -> dict:
        """Entries of a network's provenance by which other recordings are read and known."""
        recordings = self.recordings
        split = self.split
        data = self.settings.data
        source = recordings.source
        positions = recordings.taxels.positions
        hashes = recordings.hashes
        return {
            "source": source.name,
            "source_sha256": source.sha256,
            "simulated": source.simulated,
            "polarities": recordings.sensor.polarities,
            "classes": list(recordings.sensor.classes),
            "positions": None if positions is None else positions.tolist(),
            "time_unit": source.time_unit or None,
            **({"bin_ms": source.bin_ms, "rise": source.rise} if source.bin_ms else {}),
            "downsample": 1 if data.source == SIMULATED else data.downsample,
            TRAINING_RECORDINGS: sorted({hashes[i] for i in (*split.train, *split.validation)}),
        }

    def restrict_to(self, view: Settings) -> Dataset:
        """The same samples, with inputs that are made with the settings of a view only."""
        return replace(self, settings=view)

    @property
    def labels(self) -> np.ndarray:
        """The class of each sample, shape (n_samples,)."""
        return self.recordings.labels

    def subset(self, part: str):
        """The samples of a part of the split.

        Parameters
        ----------
        part : str
            ``"train"``, ``"validation"`` or ``"test"``.

        Returns
        -------
        (inputs, labels), or None
            None if the part has no samples.
        """
        index = self.split.get_indices(part)
        if not len(index):
            return None
        inputs = make_empty_array((len(index), *self.inputs.shape[1:]), self.inputs.dtype)
        for start in range(0, len(index), RECORDINGS_AT_ONCE):
            batch = slice(start, start + RECORDINGS_AT_ONCE)
            inputs[batch] = self.inputs[index[batch]]
        return inputs, self.labels[index]

    def make_altered_images(self, augmentation: str) -> AlteredImages | None:
        """The images of ``subset("train")``, altered anew for each epoch; None for ``"none"``.

        Parameters
        ----------
        augmentation : str
            ``"time"``, ``"space"`` or ``"none"``; see ``cnn.augment`` in the settings.
        """
        if augmentation == "none":
            return None
        return AlteredImages(self.recordings, self.settings.image, augmentation, self.split.train)


def make_dataset_origin(
    settings: Settings, recordings_sha256: str, split: str = "random"
) -> Origin:
    """The origin of recordings and their split.

    Parameters
    ----------
    settings : Settings
    recordings_sha256 : str
        Hash of the recordings' content.
    split : str
        See :attr:`pipeline.recordings.splits.Split.kind`.
    """
    reads = ["seed", "split.kind", "split.validation_fraction", "data.skip_bad", "skin"]
    if split != PUBLISHED:
        reads.append("split.test_fraction")
    if settings.data.source == SIMULATED:
        reads += ["data.simulation_seed", "data.samples_per_digit"]
        reads += [
            "data.writers",
            "data.chunked",
            "data.tablet",
            "data.reversed",
            "data.mixed_forms",
        ]
    else:
        reads += ["data.time_unit", "data.downsample", "data.bin", "data.rise"]
    contents = {"recordings": recordings_sha256, "split": split}
    if settings.data.source != SIMULATED:
        contents["rules of reading files"] = READING_RULES_VERSION
    return Origin.from_settings(settings, reads, contents=contents)


def _read_presentation_settings(settings):
    """The settings on which :func:`make_inputs` depends."""
    if settings.on_events:
        return settings.input, settings.steps
    return settings.image


def require_images_fit(images: np.ndarray, settings: Settings):
    """Refuse images that cannot be presented to the chip.

    Parameters
    ----------
    images : ndarray, shape (n_samples, rows, columns, channels)
    settings : Settings

    Raises
    ------
    UserError
        A pixel would spike more than once per step.
    """
    problem = settings.stimulus.find_problem(images, images.shape[1:], settings.steps)
    if problem is not None:
        raise UserError(
            f"'image.normalisation' {settings.image.normalisation!r}: {problem}; "
            "choose another, or a lower deployment.input_rate"
        )


def split_recordings(recordings: Recordings, settings: Settings) -> Split:
    """The split of recordings as in the settings.

    Raises
    ------
    UserError
        There are too few recordings, or they do not have what the split needs.
    """
    shares = settings.split
    try:
        return make_split(
            recordings,
            settings.seed,
            shares.test_fraction,
            shares.validation_fraction,
            shares.kind,
        )
    except ValueError as error:
        raise UserError(f"{settings.data.source}: {error}; {NO_SPLIT}") from error


class FramesOnDemand:
    """Frames of events that are made when they are read, for more than fit into memory.

    Parameters
    ----------
    recordings : Recordings
    settings : Settings

    Attributes
    ----------
    shape : tuple of int
        (n_samples, steps, rows, columns, 2).
    dtype : data type
    """

    def __init__(self, recordings: Recordings, settings: Settings):
        self._table = recordings.table
        self._step_ms = settings.input.step_ms
        self._limits = SpikeLimits.from_settings(settings.input)
        self.shape = (len(self._table), settings.steps, *self._table.size, 2)
        self.dtype = np.dtype(np.uint8)

    def __len__(self):
        return self.shape[0]

    def __getitem__(self, index) -> np.ndarray:
        """The frames of some samples, uint8, as of an array; one index gives one sample."""
        samples = np.arange(len(self))[index]
        indices = np.atleast_1d(samples)
        frames = np.empty((len(indices), *self.shape[1:]), np.uint8)
        for batch in np.array_split(
            np.arange(len(indices)), 1 + len(indices) // MAX_RECORDINGS_AT_ONCE
        ):
            steps = self.shape[1]
            frames_by_step = self._table.make_frames(
                indices[batch], self._step_ms, steps, self._limits
            )
            frames[batch] = np.moveaxis(frames_by_step, 0, 1)
        return frames if np.ndim(samples) else frames[0]


def make_inputs(recordings: Recordings, settings: Settings):
    """The inputs of networks, made from each recording.

    Returns
    -------
    ndarray, or FramesOnDemand if it would be larger than `MAX_FRAME_BYTES`
        With ``input.kind = "image"`` tactile images, float32, shape (n_samples, rows, columns,
        channels); with ``"events"`` the events of each step of the presentation, uint8, shape
        (n_samples, steps, rows, columns, 2), first ON, then OFF.
    """
    image = settings.image
    if settings.on_events:
        frames = FramesOnDemand(recordings, settings)
        is_large = math.prod(frames.shape) > MAX_FRAME_BYTES
        return frames if is_large else frames[:]
    return make_tactile_images(recordings, image)


def require_sensor_fits(spec: NetworkSpec, recordings: Recordings):
    """Refuse recordings of another sensor than that of a deployed network.

    Raises
    ------
    UserError
    """
    rows, columns = spec.input_shape[:2]
    sensor = recordings.sensor
    if (sensor.rows, sensor.columns) != (rows, columns):
        raise UserError(
            f"{recordings.source.name}: recordings of {sensor.rows}x{sensor.columns} taxels; the "
            f"network is for {rows}x{columns}: give recordings of its sensor"
        )


def make_inputs_for(spec: NetworkSpec, recordings: Recordings, image: Image | None = None):
    """The inputs of a deployed network for other recordings than its own.

    Parameters
    ----------
    spec : NetworkSpec
    recordings : Recordings
    image : Image, optional
        Conversion of events to images, for a network on images whose bundle does not have it.

    Returns
    -------
    ndarray
        As from :func:`make_inputs`.
    """
    stimulus = spec.stimulus
    if not stimulus.is_static:
        table = recordings.table
        steps = spec.presentation.steps
        step_ms = 1000 * stimulus.step_seconds
        frames = table.make_frames(
            np.arange(len(table)), step_ms, steps, SpikeLimits(*stimulus.spike_limits)
        )
        return np.moveaxis(frames, 0, 1)
    if (recorded := spec.provenance.image) is not None:
        image = Settings().with_values({"image": recorded}, "provenance of the bundle").image
    return make_tactile_images(recordings, image)


def list_event_warnings(settings: Settings, recordings: Recordings) -> list:
    """Warnings about events that are not presented, a line each; see setting ``input.step``.

    Raises
    ------
    UserError
        No recording has an event.
    """
    table = recordings.table
    step = settings.input.step_ms
    steps = settings.steps
    empty = int(np.sum(np.diff(table.offsets) == 0))
    if empty == len(recordings):
        raise UserError(f"{recordings.source.name}: no recording has events; use other recordings")
    shared = table.measure_loss(step)
    lost_share = table.measure_loss(step, settings.input.refractory_steps)
    lines = [
        f"events: {shared:.1%} are merged into one spike with another event of their taxel and "
        f"polarity in the same step of {step:g} ms"
    ]
    if shared > MAX_MERGED_EVENT_SHARE:
        lines[0] += "; a shorter input.step merges fewer"
    if lost_share > shared:
        refractory_ms = settings.input.refractory_steps * step
        lines.append(
            f"events: {lost_share - shared:.1%} more are ignored in their taxel's refractory "
            f"period, {refractory_ms:g} ms after a spike (input.refractory)"
        )
    if empty:
        lines.append(f"{WARNING}{empty} of {len(recordings)} recordings have no events")
    if line := describe_cut_recordings(table, step, steps):
        lines.append(f"{WARNING}{line}; choose more presentation.steps")
    return lines


def describe_cut_recordings(table: EventTable, step_ms: float, n_steps: int) -> str:
    """A note on recordings that are longer than their presentation; empty if there are none."""
    number = int(np.sum(table.duration_ms >= step_ms * n_steps))
    if not number:
        return ""
    return (
        f"{number} of {len(table)} recordings are longer than {n_steps} steps of {step_ms:g} ms, "
        "and their ends are not presented"
    )
