"""The bundle of a run: the network as the chip gets it, and the samples of its check."""

from __future__ import annotations

from dataclasses import asdict, replace

from deploy import __version__
from deploy.check.bundle import Bundle, CheckSet, read_bundle, write_bundle
from deploy.files import read_json
from deploy.network.spec import NetworkSpec
from pipeline.inputs.dataset import Dataset
from pipeline.inputs.splits import draw_check_samples
from pipeline.run.folder import DELETE_ITS_FOLDER, RunFolder, stamp_of
from pipeline.run.stages.opening import open_dataset
from pipeline.run.stages.stamps import trained_stamp
from pipeline.run.stages.training import read_weights, train_all
from pipeline.settings import Settings


def make_bundle(
    run: RunFolder, settings: Settings, jobs: int = 1, say=print, dataset: Dataset | None = None
) -> tuple:
    """Do what is missing of a run up to its bundle; return the dataset and the bundle.

    ``dataset`` is as in :func:`open_dataset`.
    """
    dataset = open_dataset(run, settings, jobs, say, dataset=dataset)
    train_all(run, settings, dataset, say)
    return dataset, convert(run, settings, dataset, say)


def convert(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> Bundle:
    """Write the bundle with the samples of its check.

    Returns
    -------
    Bundle
        The one that is there, if it is up to date.
    """
    on_events = settings.on_events
    stamp = stamp_of(
        trained_stamp(settings, dataset),
        asdict(settings.deployment),
        asdict(settings.presentation),
        asdict(settings.check),
    )
    if run.bundle.exists():
        bundle = read_bundle(run.bundle)
        if bundle.spec.provenance.get("made_from") == stamp:
            say(f"bundle: up to date ({run.bundle})")
            return bundle
    if not on_events:
        read_weights(run.cnn, settings)  # damaged ones are found now, not once the bundle is there
    chosen = draw_check_samples(dataset.split.test, settings.check.samples, settings.seed)
    recordings = dataset.recordings
    provenance = {
        "made_from": stamp,
        "source": recordings.source.name,
        "source_sha256": recordings.source.sha256,
        "simulated": recordings.source.simulated,
        "classes": list(recordings.sensor.classes),
        "seed": settings.seed,
        "recipe": "events" if on_events else settings.snn.recipe,
        "image": asdict(settings.image),
        "package": __version__,
    }
    spec = spec_of(run, settings, dataset, provenance)
    bundle = write_bundle(run.bundle, spec, _check_set(settings, dataset, chosen))
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")
    return bundle


def spec_of(run: RunFolder, settings: Settings, dataset: Dataset, provenance: dict) -> NetworkSpec:
    """The network that was trained in a run, as the chip gets it."""
    weights = read_weights(run.snn, settings)
    if not settings.on_events:
        from pipeline.run.conversion import deployed

        return deployed(settings, weights, provenance, dataset.part("train"))
    from pipeline.run.event_conversion import deployed_on_events

    early = read_json(run.snn / "metrics.json", DELETE_ITS_FOLDER)["decides_by_itself"]
    return deployed_on_events(settings, weights, early["confidence"], provenance)


def on_test_split(settings: Settings, dataset: Dataset, bundle: Bundle) -> Bundle:
    """The bundle with the whole test split as its check, in an order as random as the check's."""
    everything = draw_check_samples(dataset.split.test, len(dataset.split.test), settings.seed)
    return replace(bundle, checks=_check_set(settings, dataset, everything))


def _check_set(settings, dataset, chosen):
    recordings = dataset.recordings
    ids = tuple(recordings.ids[i] for i in chosen)
    return CheckSet(dataset.inputs[chosen], recordings.labels[chosen], ids, settings.seed)
