"""Write the bundle of a run."""

from __future__ import annotations

from deploy import __version__
from deploy.check.bundle import FILES, Bundle, CheckSet, read_bundle, write_bundle
from deploy.network.blocks import find_rescaled_layers
from deploy.network.spec import NetworkSpec
from deploy.terminal import WARNING
from pipeline.kinds.kind import NetworkKind
from pipeline.recordings.files.messages import describe_reading
from pipeline.storage.artifacts import Artifact, Origin
from pipeline.storage.run_folder import RunFolder
from pipeline.training.adaptation.adapt import add_rehearsal
from pipeline.workflow.notes import list_notes_on_recordings
from pipeline.workflow.opening import OpenedRun


def convert(opened: OpenedRun) -> Bundle:
    """Make all that the bundle is made from, and write it, unless it is current."""
    opened.make_all()
    run = opened.run
    say = opened.say
    artifact = find_bundle_artifact(run, opened.kind, opened.dataset.origin)
    state = artifact.find_state()
    origin = artifact.origin
    if state.is_current:
        say(f"bundle: up to date ({run.bundle})")
        return read_bundle(run.bundle)
    state.announce("writing", say)
    inputs = opened.make_step_inputs(origin.settings)
    seed = inputs.settings.seed
    dataset = inputs.dataset
    spec = opened.make_spec(_make_provenance(opened, inputs, origin))
    spec = add_rehearsal(spec, dataset.inputs, dataset.labels, dataset.split.train, seed)
    bundle = write_bundle(run.bundle, spec, _choose_check_samples(inputs))
    say(f"bundle: {bundle.id[:12]} written to {run.bundle}")
    if opened.kind.is_trained_in_integers:
        for name in find_rescaled_layers(spec.layers):
            say(
                f"{WARNING}{name}: needs several cores, and NengoLoihi scales the weights of each "
                "by themselves, so that its integers differ slightly from those of the training; "
                "compare them with 'stmnist ladder', or use fewer neurons"
            )
    return bundle


def _make_provenance(opened, inputs, origin) -> dict:
    """The provenance that is stored in a bundle."""
    recordings = inputs.dataset.recordings
    lost_lines = describe_reading(recordings.source.name, recordings)
    notes = (*lost_lines, *list_notes_on_recordings(opened))
    return {
        "made_from": origin.to_json(),
        **inputs.dataset.provenance,
        "seed": inputs.settings.seed,
        "recipe": opened.kind.recipe,
        "package": __version__,
        "warnings": [note.removeprefix(WARNING) for note in notes if note.startswith(WARNING)],
    }


def _choose_check_samples(inputs) -> CheckSet:
    """The samples of a bundle's check."""
    dataset = inputs.dataset
    seed = inputs.settings.seed
    number = inputs.settings.check.count_samples(len(dataset.split.test))
    chosen = dataset.split.draw_check_samples(number, seed)
    recordings = dataset.recordings.subset(chosen)
    return CheckSet(dataset.inputs[chosen], recordings.labels, recordings.ids, seed)


def find_bundle_artifact(
    run: RunFolder, kind: NetworkKind, dataset_origin: Origin, name="bundle"
) -> Artifact:
    """The bundle of a run, or one that was adapted from it, such as ``"adapted/7"``."""
    network, *others = (run.path / name / file for file in (*FILES, "MANIFEST.json"))
    origin = kind.make_bundle_origin(dataset_origin)
    return Artifact(name, network, origin, tuple(others), _read_bundle_record)


def _read_bundle_record(network):
    provenance = network.get("provenance")
    return provenance.get("made_from") if isinstance(provenance, dict) else None


def list_network_settings(spec: NetworkSpec) -> dict:
    """The settings that a bundle's network was made with, by their dotted names.

    Settings that have no effect on it are not among them.
    """
    settings = spec.provenance.settings
    # A run whose steps are the default, 0, may have as many as one with a number.
    steps = settings.get("presentation.steps") or spec.presentation.steps
    return {**settings, "presentation.steps": steps}
