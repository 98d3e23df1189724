"""The interface that each kind of network implements.

A kind determines the artifacts from which the bundle is made, the deployed network, the reference
stages of the ladder, and the settings that are chosen for the recordings.  Other
packages ask only whether a run's input is events, and :mod:`pipeline.workflow.imports` knows the
files from which networks are imported.
"""

from typing import ClassVar

import numpy as np

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.network.spec import NetworkSpec
from models.architecture import parse_architecture
from pipeline.kinds.architectures import (
    is_for_sensor,
    list_chip_problems,
    suggest_architecture,
    suggest_sensor_size,
)
from pipeline.kinds.imported import ImportedNetwork
from pipeline.kinds.steps import Step, StepInputs
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.recordings import Recordings
from pipeline.settings import Choice, Settings
from pipeline.storage.artifacts import Artifact, Origin


class NetworkKind:
    """Base class of the kinds of networks.

    A kind has `name`, `input_kinds`, `deployed_step`, `deployed_stage` and `channels`, the
    properties `steps` and `trained_steps`, and `make_spec`; with an architecture in its settings,
    also `settings_group`.  All else has a default.

    :func:`pipeline.kinds.registry.register_kind` adds a kind.  ``RandomKind`` in
    tests/extensions/test_from_outside.py is a complete one.

    Parameters
    ----------
    settings : Settings
    """

    # Name of the kind.
    name: ClassVar[str]
    # Values of ``input.kind`` that select it.
    input_kinds: ClassVar[tuple] = ()
    # The :class:`Reference` stages of the ladder by their names, in order.
    references: ClassVar[dict] = {}
    # Name of the step whose artifact the bundle is made from.
    deployed_step: ClassVar[str]
    # The reference stage of the network that becomes the bundle.  Conversion causes the losses from
    # this stage on.
    deployed_stage: ClassVar[str]
    # Reference stages with which the deployed network is compared, in order of preference: the
    # first that the ladder has is taken, or else the deployed stage.
    compared_stages: ClassVar[tuple] = ()
    # Settings that the bundle depends on, in addition to those of presentation and check.
    bundle_settings: ClassVar[tuple] = ()
    # Group of settings with the architecture; empty if the user's file determines it.
    settings_group: ClassVar[str] = ""
    # Number of channels of the input.
    channels: ClassVar[int]
    # What to try if the network is less accurate than ``counts``.
    remedy: ClassVar[str] = "the other --input, a wider architecture or more epochs"
    # Values of settings that a sweep tries unless the user names others.
    grid: ClassVar[tuple] = ()

    def __init__(self, settings: Settings):
        self.settings = settings

    @classmethod
    def is_selected_by(cls, settings: Settings) -> bool:
        """True if these settings are those of a network of this kind."""
        return settings.input.kind in cls.input_kinds

    @property
    def architecture(self) -> str:
        """The architecture in the paper's notation; empty if the user's file determines it."""
        if not self.settings_group:
            return ""
        return getattr(self.settings, self.settings_group).architecture

    @property
    def reference_stages(self) -> tuple:
        """Names of the stages of :attr:`references` that the ladder of these settings has."""
        return tuple(self.references)

    @property
    def deployed_stages(self) -> tuple:
        """Names of the reference stages whose networks the bundle is made from."""
        return tuple(
            name for name, stage in self.references.items() if self.is_deployed(stage.step)
        )

    @property
    def steps(self) -> tuple:
        """The :class:`pipeline.kinds.steps.Step` of each artifact before the bundle, in order."""
        raise NotImplementedError

    @property
    def trained_steps(self) -> tuple:
        """Names of the steps that ``stmnist train`` makes.

        Raises
        ------
        UserError
            The network was trained elsewhere.
        """
        raise NotImplementedError

    @property
    def recipe(self) -> str:
        """How the network was made, for the bundle's provenance: ``snn.recipe`` of images."""
        return self.name

    @property
    def is_trained_in_integers(self) -> bool:
        """True if the chip's integers are those of the trained network."""
        return True

    @property
    def imported(self) -> ImportedNetwork | None:
        """The user's file that the network is read from, if there is one."""
        return None

    def find_step(self, name: str) -> Step:
        """The step with a name."""
        steps = {step.name: step for step in self.steps}
        if name not in steps:
            raise ValueError(f"no step {name!r}; the steps are {', '.join(steps)}")
        return steps[name]

    def make_origin(self, name: str, dataset_origin: Origin) -> Origin:
        """The origin of a step, from that of the dataset."""
        step = self.find_step(name)
        uses = [self.make_origin(used, dataset_origin) for used in step.uses] or [dataset_origin]
        return Origin.from_settings(self.settings, step.reads, uses)

    def list_steps_to(self, name: str) -> tuple:
        """A step and those that it is made from, directly or through others, in order."""
        names = self._collect_uses(name)
        return tuple(step for step in self.steps if step.name in names)

    def _collect_uses(self, name):
        """The names of a step and of all that it is made from."""
        names = {name}
        for used in self.find_step(name).uses:
            names |= self._collect_uses(used)
        return names

    def is_deployed(self, name: str) -> bool:
        """True if the bundle is made from a step, directly or through others."""
        return any(step.name == name for step in self.list_steps_to(self.deployed_step))

    def find_artifact(self, name: str, store, dataset_origin: Origin) -> Artifact:
        """The artifact of a step, in a run's folder or in a library."""
        step = self.find_step(name)
        origin = self.make_origin(name, dataset_origin)
        folder = store.find_folder(step.folder, origin)
        record, *files = (folder / file for file in step.files)
        return Artifact(name, record, origin, tuple(files))

    def make_bundle_origin(self, dataset_origin: Origin) -> Origin:
        """The origin of the bundle."""
        reads = [*self.bundle_settings, "presentation", "check"]
        return Origin.from_settings(
            self.settings, reads, [self.make_origin(self.deployed_step, dataset_origin)]
        )

    def list_shapes(self, name: str) -> dict:
        """The shapes of the arrays that a step has, by their names."""
        raise NotImplementedError

    def make_spec(self, inputs: StepInputs, provenance: dict) -> NetworkSpec:
        """The deployed network.

        Parameters
        ----------
        inputs : StepInputs
            With the settings that the bundle depends on, and the artifacts of the steps.
        provenance : dict
            Stored in the bundle.
        """
        raise NotImplementedError

    def compare_layers(self, inputs: StepInputs, bundle: Bundle, advance=None) -> list | None:
        """Compare the firing rates on the chip with those of the trained network.

        Returns
        -------
        list of dict or None
            See :func:`pipeline.kinds.diagnosis.compare_rates`; None without a network with rates.
        """
        return None

    def make_choices(self, recordings: Recordings, train: np.ndarray) -> list[Choice]:
        """Choose settings that the user has not set, for the recordings.

        Parameters
        ----------
        recordings : Recordings
        train : ndarray of int
            Indices of the training samples; none if there can be no split.

        Raises
        ------
        UserError
            The user's other settings do not fit what is chosen.
        """
        return []

    def require_recordings_fit(self, recordings: Recordings):
        """Refuse recordings of another sensor or with other classes than the network is for.

        Raises
        ------
        UserError
        """
        sensor = recordings.sensor
        classes = len(sensor.classes)
        if is_for_sensor(self.architecture, sensor, self.channels):
            return
        size = f"{sensor.rows}x{sensor.columns}x{self.channels}"
        parsed = parse_architecture(self.architecture)
        if self.imported is not None:
            input_size = "x".join(map(str, parsed.input_shape))
            remedy = suggest_sensor_size(parsed.input_shape[:2], (sensor.rows, sensor.columns))
            raise UserError(
                f"{self.imported.file}: is for an input of {input_size} and {parsed.outputs} "
                f"classes; recordings give {size} and {classes} classes: {remedy}train one for "
                "these recordings, or give those that it was trained on (--data) or their images "
                "(--set image.slices, image.aggregation)"
            )
        example = suggest_architecture(sensor, self.settings.on_events, n_channels=self.channels)
        raise UserError(
            f"{self.settings.data.source}: '{self.settings_group}.architecture' must be for an "
            f"input of {size} and {classes} classes, such as {example}, not {self.architecture}"
        )

    def list_chip_problems(self) -> tuple:
        """Reasons why the network does not fit the cores of the chip, a line each.

        A user's network is examined when it is read.
        """
        default_kind = type(self)(Settings())
        if not self.settings_group or (self.architecture, self.settings.deployment) == (
            default_kind.architecture,
            default_kind.settings.deployment,
        ):
            return ()
        return list_chip_problems(
            self.architecture, self.settings.on_events, self.settings.deployment
        )

    def require_presentable(self, dataset: Dataset):
        """Refuse samples that cannot be presented to the chip.

        Raises
        ------
        UserError
        """

    def require_usable(self, inputs: StepInputs):
        """Refuse a network of the user that cannot be used, before anything is written.

        Raises
        ------
        UserError
        """

    def list_notes(self, recordings: Recordings) -> list:
        """Lines for the user about the presentation of the recordings."""
        return []
