"""The bundle of a run: the network for the chip, and the samples of its check."""

from __future__ import annotations

from dataclasses import asdict, replace

from deploy import __version__
from deploy.check.bundle import Bundle, CheckSet, read_bundle, write_bundle
from deploy.files import reporting_damage
from deploy.network.blocks import scaled_by_block
from deploy.network.spec import NetworkSpec
from deploy.terminal import WARNING
from pipeline.artifacts import DELETE_IT, Artifact, Origin
from pipeline.data.dataset import Dataset
from pipeline.roads.conversion import deployed, deployed_nir, deployed_on_events
from pipeline.roads.origins import bundle_origin
from pipeline.run import RunFolder
from pipeline.settings import SIMULATED, Settings
from pipeline.stages.opening import open_dataset
from pipeline.stages.training import (
    Place,
    network_artifact,
    read_weights,
    train_all,
    weights_of,
)
from pipeline.training.adaptation import with_rehearsal


def make_bundle(
    run: RunFolder, settings: Settings, jobs: int = 1, say=print, dataset: Dataset | None = None
) -> tuple:
    """Make the missing artifacts of a run up to its bundle.

    Parameters
    ----------
    run, settings, jobs, say, dataset
        As in :func:`open_dataset`, whose ``warn`` is ``say``; it also gets a line for each stage.

    Returns
    -------
    Dataset, Bundle
    """
    dataset = open_dataset(run, settings, jobs, say, dataset=dataset)
    train_all(run, settings, dataset, say)
    return dataset, convert(run, settings, dataset, say)


def convert(run: RunFolder, settings: Settings, dataset: Dataset, say=print) -> Bundle:
    """Write the bundle with the samples of its check, unless it is current.

    Returns
    -------
    Bundle
    """
    artifact = bundle_artifact(run, settings, dataset.origin)
    state, origin = artifact.state(), artifact.origin
    if state.is_current:
        say(f"bundle: up to date ({run.bundle})")
        return read_bundle(run.bundle)
    if (line := state.announcement("writing")) is not None:
        say(line)
    view = origin.view(settings)
    seen = dataset.seen_by(view)
    if view.network == "image":
        # A damaged CNN is found now, not when its answers are compared.
        read_weights(run.cnn, view)
    test = seen.split.test
    chosen = seen.split.check_samples(view.check.drawn(len(test)), view.seed)
    source = seen.recordings.source
    provenance = {
        "made_from": origin.to_json(),
        "source": source.name,
        "source_sha256": source.sha256,
        "simulated": source.simulated,
        "classes": list(seen.recordings.sensor.classes),
        "polarities": seen.recordings.sensor.polarities,
        "seed": view.seed,
        "recipe": view.snn.recipe if view.network == "image" else view.network,
        "image": asdict(view.image),
        "package": __version__,
        **({"time_unit": source.time_unit} if source.time_unit else {}),
        **_downsample(view, dataset),
    }
    spec = spec_of(run, view, seen, provenance)
    spec = with_rehearsal(spec, seen.inputs, seen.labels, seen.split.train, view.seed)
    bundle = write_bundle(run.bundle, spec, _check_set(view, seen, chosen))
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")
    trained_as_reals = provenance["recipe"] in ("paper", "as-is")
    for name in () if trained_as_reals else scaled_by_block(spec.layers):
        say(
            f"{WARNING}{name}: is divided among cores by its outputs, and NengoLoihi scales the "
            "weights of each core separately, so that its integers differ slightly from those of "
            "training; compare the predictions of 'stmnist ladder', or use fewer neurons"
        )
    return bundle


def _downsample(settings, dataset):
    """The downsampling of files, which other recordings of the sensor need too."""
    if dataset.is_of_arrays or settings.data.source == SIMULATED:
        return {}
    n = settings.data.downsample
    return {"downsample": n} if n > 1 else {}


def bundle_artifact(run: RunFolder, settings: Settings, dataset: Origin) -> Artifact:
    """The bundle of a run."""
    network, manifest = run.bundle / "network.json", run.bundle / "MANIFEST.json"
    origin = bundle_origin(settings, dataset)
    return Artifact("bundle", network, origin, (manifest,), _recorded_in_bundle)


def _recorded_in_bundle(network):
    """The origin recorded in ``network.json``, also by earlier versions."""
    provenance = network.get("provenance")
    return provenance.get("made_from") if isinstance(provenance, dict) else None


def spec_of(place: Place, settings: Settings, dataset: Dataset, provenance: dict) -> NetworkSpec:
    """The deployed network from the trained network of a run or library."""
    source = place, settings, dataset.origin
    if settings.network == "nir":
        graph = network_artifact("nir", *source)
        return deployed_nir(graph.folder, _confidence(graph), settings, dataset, provenance)
    if settings.on_events:
        confidence = _confidence(network_artifact("threshold", *source))
        weights = weights_of("events", *source)
        return deployed_on_events(settings, weights, confidence, provenance)
    weights = weights_of("rate-lif", *source)
    return deployed(settings, weights, provenance, dataset.part("train"))


def _confidence(artifact):
    """The confidence for early decisions in a network's record, or None."""
    with reporting_damage(artifact.record, DELETE_IT):
        chosen = artifact.state().record["decides_by_itself"]
        if chosen is not None and not 0 <= chosen["confidence"] <= 1:
            raise ValueError("a confidence that is not from 0 to 1")
        return chosen and float(chosen["confidence"])


def on_test_split(settings: Settings, dataset: Dataset, bundle: Bundle) -> Bundle:
    """The bundle with the whole test split as its check, in random order like the check's."""
    everything = dataset.split.check_samples(len(dataset.split.test), settings.seed)
    return replace(bundle, checks=_check_set(settings, dataset, everything))


def _check_set(settings, dataset, chosen):
    recordings = dataset.recordings
    ids = tuple(recordings.ids[i] for i in chosen)
    return CheckSet(dataset.inputs[chosen], recordings.labels[chosen], ids, settings.seed)
