"""The check on other recordings than the bundle's, for the command line and for Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from deploy.check.bundle import Bundle
    from pipeline.recordings.faulty_taxels import FaultCounts
    from pipeline.workflow.target_check import TargetCheck


@dataclass(frozen=True)
class OtherRecordings:
    """Recordings that a bundle is checked on instead of its own samples, or that it classifies.

    Attributes
    ----------
    data : str or None
        Zip or folder, for predictions also one file; None for the bundle's own samples.
    samples : int or None
        Number of recordings drawn at random; 0 for all, None for at most 200.
    skip_bad : bool
        True to leave out files that cannot be read.
    time_unit : str
        Unit of times in files of events; empty: the files' own, or that of the training.
    jobs : int
        Number of processes that read the recordings.
    name : str
        What messages and results call the recordings; empty: the name of the zip or folder.
    """

    data: str | None = None
    samples: int | None = None
    skip_bad: bool = False
    time_unit: str = ""
    jobs: int = 2
    name: str = ""


def check_on_others(
    bundle: Bundle,
    others: OtherRecordings,
    check: TargetCheck,
    say,
    faults: FaultCounts | None = None,
    out: Path | None = None,
) -> tuple:
    """Run a target on other recordings, and write the result.

    Parameters
    ----------
    bundle : Bundle
    others : OtherRecordings
    check : TargetCheck
        Its seed also determines which recordings are drawn.
    say : callable
        Called with each warning.
    faults : FaultCounts, optional
        Faulty taxels in each recording.
    out : Path, optional
        Default: a file next to the bundle, one for each set of recordings.

    Returns
    -------
    result : CheckResult
    path : Path
        The file of the result.

    Raises
    ------
    UserError
        The recordings cannot be read, are of another sensor or other classes, or are too few.
    """
    from deploy.check.results import write_result
    from pipeline.results import check_with_faults, other_recordings

    assert others.data is not None, "the bundle's own samples are no other recordings"
    settings = other_recordings.find_settings_around(bundle, others.skip_bad, others.time_unit)
    recordings = other_recordings.read_others(bundle, others, settings, say)
    for line in other_recordings.list_warnings(bundle, recordings):
        say(line)
    presented, indices = other_recordings.replace_check_samples(
        bundle, recordings, others.samples, check.seed, settings.image
    )
    path = other_recordings.find_result_path(bundle, recordings, len(indices), check.target)
    if faults is not None:
        path = check_with_faults.find_fault_path(path, faults)
        drawn = recordings.subset(indices)
        presented = check_with_faults.add_faults_to_check(presented, drawn, faults, settings.image)
    path = out or path
    result = check.run(presented, path)
    result = other_recordings.add_accuracies(result, bundle, recordings, indices)
    if faults is not None:
        return check_with_faults.add_fault_note(result, path, faults), path
    write_result(path, result)
    return result, path
