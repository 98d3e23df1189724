"""The work on a run: open it, train, convert, and check; what is current is not made again.

:func:`open_run` loads the recordings and chooses what the settings leave open; the others take what
it returns: :meth:`OpenedRun.make` trains a network, :func:`convert` writes the bundle, and
:func:`check_stage` runs a network or target on its samples.
"""

from pipeline.kinds.image.kind import settings_of_model
from pipeline.kinds.nir.importing import refuse_early, settings_of_nir
from pipeline.stages.checks import check_artifact, check_stage, check_stages
from pipeline.stages.conversion import bundle_artifact, convert, settings_of_network
from pipeline.stages.opening import (
    OpenedRun,
    dataset_artifact,
    open_experiment,
    open_locked_run,
    open_run,
)

__all__ = [
    "OpenedRun",
    "bundle_artifact",
    "check_artifact",
    "check_stage",
    "check_stages",
    "convert",
    "dataset_artifact",
    "open_experiment",
    "open_locked_run",
    "open_run",
    "refuse_early",
    "settings_of_model",
    "settings_of_network",
    "settings_of_nir",
]
