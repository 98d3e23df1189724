"""A check with faulty taxels: the same network on its samples with hot and dead taxels."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from deploy.check.bundle import Bundle
from deploy.check.results import CheckResult, write_result
from deploy.errors import UserError
from pipeline.recordings.dataset import make_inputs_for
from pipeline.recordings.faulty_taxels import CHECK_PERIOD_MS, FaultCounts, add_faults
from pipeline.recordings.recordings import Recordings
from pipeline.settings import Image, read_settings
from pipeline.sources import load_named_recordings
from pipeline.storage.run_folder import run_around

# Maximum number of taxels with the same fault.
MAX_FAULTS = 1000


def parse_faults(texts) -> FaultCounts:
    """Numbers in texts such as ``"hot=1"`` and ``"hot=1,dead=5"``.

    Raises
    ------
    UserError
        A text is of another form, or a fault is named twice.
    """
    counts: dict = {}
    for entry in ",".join(texts).split(","):
        match = re.fullmatch(r"\s*(hot|dead)\s*=\s*(\d{1,4})\s*", entry)
        if match is None or match[1] in counts or int(match[2]) > MAX_FAULTS:
            raise UserError(
                f"--fault {entry!r}: give each of hot and dead once, with a number of taxels "
                f"of at most {MAX_FAULTS}, such as --fault hot=1,dead=5"
            )
        counts[match[1]] = int(match[2])
    return FaultCounts(**counts)


def read_check_recordings(bundle: Bundle, jobs: int = 1, warn=None) -> tuple:
    """The recordings of a bundle's check samples, from the source of its run.

    Returns
    -------
    recordings : Recordings
        In the order of the samples.
    image : pipeline.settings.groups.Image
        Conversion of events to images in the run's settings.

    Raises
    ------
    UserError
        The bundle is not in a run, or the source no longer has its samples.
    """
    run = run_around(bundle.path)
    if run is None:
        raise UserError(
            f"{bundle.path}: is in no run, so that the recordings of its samples are not known; "
            "give recordings with --data FILE"
        )
    settings = read_settings(run / "experiment.toml")
    recordings = load_named_recordings(settings, jobs, warn)
    number = {name: index for index, name in enumerate(recordings.ids)}
    missing = [name for name in bundle.checks.ids if name not in number]
    if missing:
        raise UserError(
            f"{settings.data.source}: does not have the recording {missing[0]} of the check any "
            "more; give others with --data FILE"
        )
    return recordings.subset([number[name] for name in bundle.checks.ids]), settings.image


def add_faults_to_check(
    bundle: Bundle, recordings: Recordings, counts: FaultCounts, image: Image | None = None
) -> Bundle:
    """The bundle with faulty taxels in the samples of its check.

    Parameters
    ----------
    bundle : Bundle
    recordings : Recordings
        The recordings of the samples, in their order.
    counts : FaultCounts
        The places are drawn with the seed of the check's samples.
    image : pipeline.settings.groups.Image, optional
        Conversion of events to images, for a bundle that does not have it.

    Raises
    ------
    UserError
        The sensor has fewer taxels, or the result cannot be presented to the network.
    """
    try:
        faulty = add_faults(recordings, counts, bundle.checks.seed)
    except ValueError as error:
        raise UserError(f"--fault: {error}") from error
    spec = bundle.spec
    inputs = make_inputs_for(spec, faulty, image)
    if problem := spec.stimulus.find_problem(inputs, spec.input_shape, spec.presentation.steps):
        raise UserError(f"--fault: {problem}")
    return replace(bundle, checks=replace(bundle.checks, inputs=inputs))


def find_fault_path(path: Path, counts: FaultCounts) -> Path:
    """The file of a result with faults, in the same folder as that of the result without."""
    return path.with_name(f"{path.stem}-{counts}.json")


def add_fault_note(result: CheckResult, path: Path, counts: FaultCounts) -> CheckResult:
    """Write the result with the numbers of faulty taxels."""
    note = {"hot": counts.hot, "dead": counts.dead, "hot_period_ms": CHECK_PERIOD_MS}
    result = replace(result, fault=note)
    write_result(path, result)
    return result
