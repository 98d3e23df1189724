"""What the training of each network depends on, as a hash: of another, it is trained again."""

from __future__ import annotations

from dataclasses import asdict

from deploy import __version__
from deploy.network.decision import Judge
from pipeline.inputs.dataset import Dataset
from pipeline.run.folder import stamp_of
from pipeline.settings import Settings


def cnn_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the CNN's training depends on."""
    cnn = asdict(settings.cnn)
    if cnn.pop("model"):  # whose content counts, wherever it lies; nothing is trained
        cnn = {name: cnn[name] for name in ("architecture", "model_sha256")}
    parts = map(asdict, (settings.data, settings.skin, settings.image, settings.split))
    source = dataset.recordings.source.sha256
    return stamp_of(__version__, source, settings.seed, *parts, cnn)


def snn_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the rate-based network's training depends on."""
    return stamp_of(cnn_stamp(settings, dataset), asdict(settings.snn))


def events_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the training on events depends on."""
    parts = (settings.data, settings.input, settings.split, settings.events)
    recordings = dataset.recordings
    judge = Judge.shapes(len(recordings.sensor.classes))
    return stamp_of(
        __version__, recordings.source.sha256, settings.seed, *map(asdict, parts), judge
    )


def trained_stamp(settings: Settings, dataset: Dataset) -> str:
    """Hash of all that the training of the network for the chip depends on."""
    return (events_stamp if settings.on_events else snn_stamp)(settings, dataset)
