"""Read the artifacts of a run for its report."""

from dataclasses import replace
from pathlib import Path

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.errors import UserError
from deploy.files import read_json, reporting_damage
from deploy.preflight.plan import make_plan
from deploy.terminal import format_command
from pipeline.kinds.records import read_history
from pipeline.kinds.registry import find_kind
from pipeline.progress import progress
from pipeline.results.ladder import list_stages, select_deployed_result
from pipeline.results.other_recordings import FOLDER as OTHERS
from pipeline.results.report.page import ReportData
from pipeline.results.report.samples import choose_samples, replay_samples
from pipeline.results.status import find_outdated, list_states
from pipeline.settings import read_settings
from pipeline.storage.run_folder import RunFolder, require_run

REMEDY = "delete it and make it again"

# More chips than any system has: the report says how many a network needs.
MANY_CHIPS = 10_000


def gather_report_data(folder: RunFolder) -> ReportData:
    """Read a run, and replay the samples that its report shows.

    Parameters
    ----------
    folder : RunFolder

    Raises
    ------
    UserError
        There is no bundle or no check result, or a file is damaged.
    """
    require_run(folder)
    settings = read_settings(folder.experiment)
    bundle = read_bundle(folder.bundle)
    kind = find_kind(settings)
    stages = [stage for stage in list_stages(kind) if folder.find_check_file(stage).exists()]
    results = [read_result(folder.find_check_file(stage)) for stage in stages]
    for stage, result in zip(stages, results, strict=True):
        if result.target != stage or not {*result.spikes} <= {*bundle.spec.spiking_layers}:
            raise UserError(
                f"{folder.find_check_file(stage)}: is of another target or network; {REMEDY}"
            )
    results = [result for result in results if result.bundle_id == bundle.id]
    if not results:
        raise UserError(
            f"{folder.path / 'checks'}: no check result of the present bundle; "
            f"run {format_command('ladder', folder.path)} first"
        )
    chosen = choose_samples(select_deployed_result(results))
    with progress("replay samples", len(chosen)) as advance:
        replays = replay_samples(bundle, chosen, settings.seed, advance)
    titles: dict = {}
    metrics: dict = {}
    histories: dict = {}
    for reference in kind.references.values():
        titles.setdefault(
            folder.find_folder(kind.find_step(reference.step).folder), reference.title
        )
    for path, title in titles.items():
        if (path / "metrics.json").exists():
            metrics[title] = _read_test_accuracy(path / "metrics.json")
        if (path / "history.csv").exists():
            histories[title] = read_history(path / "history.csv")
    return ReportData(
        name=str(folder.path),
        settings=settings,
        bundle=bundle,
        results=results,
        metrics=metrics,
        histories=histories,
        plan=make_plan(bundle.spec, MANY_CHIPS).to_json(),
        replays=replays,
        outdated=find_outdated(list_states(folder)),
        others=_read_others(folder, bundle),
    )


def _read_test_accuracy(path):
    """The record of a training, with the accuracy that the page shows."""
    metrics = read_json(path, REMEDY)
    with reporting_damage(path, REMEDY):
        return {"accuracy": float(metrics["accuracy"]["test"]), "n_test": int(metrics["n_test"])}


def _read_others(folder, bundle):
    """Results of the bundle on other recordings; see :mod:`pipeline.results.other_recordings`."""
    files = sorted(Path(folder.path / "checks" / OTHERS).glob("*.json"))
    results = [read_result(path, REMEDY) for path in files]
    own = [
        result
        for result in results
        if result.bundle_id == bundle.id and result.per_class is not None and result.data
    ]
    return [replace(each, data=replace(each.data, source=_title_source(each, own))) for each in own]


def _title_source(result, results):
    """The name of a result's recordings, with the begin of their hash if others have this name."""
    data = result.data
    hashes = {each.data.sha256 for each in results if each.data.source == data.source}
    return data.source if len(hashes) == 1 else f"{data.source} ({data.sha256[:6]})"
