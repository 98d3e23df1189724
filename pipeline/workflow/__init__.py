"""The work on a run: open it, train, convert, and check; what is current is not made again.

:func:`open_run` loads the recordings and chooses what the settings leave open; the others take what
it returns: :meth:`OpenedRun.make` trains a network, :func:`convert` writes the bundle, and
:func:`check_stage` runs a network or target on its samples.
"""

from pipeline.workflow.checks import (
    check_stage,
    check_stages,
    convert_and_check,
    make_check_artifact,
)
from pipeline.workflow.conversion import convert, find_bundle_artifact, list_network_settings
from pipeline.workflow.imports import ImportRequest
from pipeline.workflow.opening import (
    OpenedRun,
    find_dataset_artifact,
    open_experiment,
    open_locked_run,
    open_run,
)

__all__ = [
    "ImportRequest",
    "OpenedRun",
    "check_stage",
    "check_stages",
    "convert",
    "convert_and_check",
    "find_bundle_artifact",
    "find_dataset_artifact",
    "list_network_settings",
    "make_check_artifact",
    "open_experiment",
    "open_locked_run",
    "open_run",
]
