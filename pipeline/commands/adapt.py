"""``stmnist adapt``: the readout fitted to one person."""

from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import refuse_linked_folder
from deploy.tables import list_names
from pipeline.commands import options


def adapt(  # noqa: PLR0913 - each is an option of the command
    run: Annotated[Path, typer.Argument(help="Folder of a run, or of a copied bundle.")],
    data: Annotated[
        str, typer.Option(help="Zip or folder of the person's recordings of every class.")
    ],
    writer: Annotated[
        int | None, typer.Option(help="The writer to use, if there are several.", min=0)
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the new bundle.", show_default="RUN/adapted/WRITER"),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fit.", min=0, max=2**31 - 1)] = 0,
    skip_bad: options.SkipBad = False,
    time_unit: options.TimeUnit = "",
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Fit the readout to one person from a few labelled recordings, in a new bundle.

    Nothing is written if the accuracy in cross-validation on the person's recordings does not
    improve, or the network's training samples lose too much.  The original bundle is not changed.
    """
    from deploy.check.bundle import read_bundle, require_replaceable, write_bundle
    from pipeline.results import other_recordings
    from pipeline.training.adaptation import adapt as adaptation  # imports Nengo, for a second

    bundle = read_bundle(options.find_bundle(run))
    options.warn_if_outdated(bundle.path)
    settings = other_recordings.find_settings_around(bundle, skip_bad, time_unit)
    everyone = other_recordings.read_recordings_for(bundle, data, settings, jobs, options.say)
    recordings, who = _select_person(everyone, writer)
    for line in other_recordings.list_warnings(bundle, recordings):
        options.say(line)
    adaptation.require_adaptable_recordings(bundle.spec, recordings)
    folder = out or _find_default_folder(run, bundle, who)
    if folder.resolve() == bundle.path.resolve():
        raise UserError(f"{folder}: is the bundle to adapt; choose another --out")
    require_replaceable(folder)
    if out is None and folder.exists():
        _require_same_person(folder, read_bundle(folder), bundle, recordings)
    adapted = adaptation.adapt(bundle, recordings, who, seed)
    written = None
    if adapted.spec is not None:
        write_bundle(folder, adapted.spec, bundle.checks)
        written = folder
    trained_on = int(other_recordings.find_trained_on(bundle, recordings).sum())
    summary = _summarise(adapted, written, len(recordings), trained_on)
    options.print_result(summary, lambda _: adaptation.format_adaptation(adapted, written), as_json)


def _find_default_folder(run, bundle, who):
    """The folder of the new bundle: in the run, or next to a bundle without a run."""
    parent = run / "adapted"
    if bundle.path == run:
        alone = run.absolute()
        parent = alone.with_name(f"{alone.name}-adapted")
    refuse_linked_folder(parent)
    return parent / who


def _summarise(adapted, folder, samples, trained_on):
    """What the fit has changed, for ``--json``."""
    fit = adapted.fit
    return {
        "before": float(fit.before.mean()),
        "after": float(fit.after.mean()),
        "others_before": _compute_mean(adapted.others_before),
        "others_after": _compute_mean(adapted.others_after),
        "kept_before": float(fit.kept_before.mean()),
        "kept_after": float(fit.kept_after.mean()),
        "bundle": None if folder is None else str(folder),
        "samples": samples,
        "trained_on": trained_on,
        "in_check": adapted.fitted,
    }


def _require_same_person(folder, old, bundle, recordings):
    """Refuse to replace a network that was fitted to none of these recordings."""
    from deploy.network.provenance import read_training_hashes

    fitted_to = read_training_hashes(old.spec) - read_training_hashes(bundle.spec)
    if fitted_to and fitted_to.isdisjoint(recordings.hashes):
        raise UserError(
            f"{folder}: is fitted to other recordings, perhaps another person's; "
            "choose another --out, or delete it"
        )


def _compute_mean(right):
    """The share of right predictions; None without samples."""
    return float(right.mean()) if len(right) else None


def _select_person(recordings, writer) -> tuple:
    """One person's recordings, and what to call the person."""
    source = recordings.source.name
    writers = sorted(set(recordings.writers.tolist()))
    if writer is None:
        if len(writers) > 1:
            raise UserError(
                f"{source}: has writers {list_names(writers)}; choose one with --writer"
            )
        return recordings, str(writers[0]) if writers and writers[0] >= 0 else Path(source).stem
    if writer not in writers:
        raise UserError(f"{source}: no recording of writer {writer}; give another --writer")
    return recordings.subset((recordings.writers == writer).nonzero()[0]), str(writer)
