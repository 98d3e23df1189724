"""The road of networks that were trained elsewhere and come as a NIR graph."""

from __future__ import annotations

from deploy.errors import UserError
from models.nir_graph import read_nir
from pipeline.data.dataset import event_warnings, require_images_fit
from pipeline.roads import counts
from pipeline.roads.conversion import deployed_nir
from pipeline.roads.events import confidence_of, presentation_choices
from pipeline.roads.imported import Imported, is_file
from pipeline.roads.nir_answers import NUMPY, graph_responses
from pipeline.roads.nir_import import graph_for, require_fit, take_over
from pipeline.roads.nir_settings import GRAPH, give_again
from pipeline.roads.road import Part, Reference, Road


def _respond(stage, opened, bundle, advance):
    return graph_responses(opened.artifact("nir").folder, opened.settings, bundle, advance)


class NirRoad(Road):
    """A NIR graph, on images or on events."""

    kind = "nir"
    references = {  # noqa: RUF012 - declared as a class variable in the base
        "counts": counts.REFERENCE,
        "nir": Reference(
            "NIR",
            "the graph as written, in floating point, each sample from rest",
            "nir",
            _respond,
            lambda: NUMPY,
        ),
    }
    deployed = "nir"

    @property
    def channels(self):
        return 2 if self.settings.on_events else 1

    @property
    def placement(self):
        return () if self.settings.on_events else ("deployment",)

    @property
    def parts(self):
        shown = ("presentation.steps",) if self.settings.on_events else ("presentation", "image")
        reads = ("input", "nir.sha256", "nir.step", "nir.method", "nir.reset", *shown)
        files = ("metrics.json", GRAPH)
        return counts.PART, Part("nir", "snn", files, reads, self._read, action="reading")

    @property
    def trained(self):
        raise UserError(
            f"the network is the NIR graph {self.settings.nir.file}, which is already trained; use "
            "'stmnist convert', or train a network in a new folder"
        )

    @property
    def imported(self):
        nir = self.settings.nir
        return Imported(nir.file, nir.sha256, "nir", give_again(self.settings))

    @staticmethod
    def _read(opened, artifact):
        """Make the user's graph the run's network."""
        return take_over(artifact.folder, opened.settings, opened.dataset, opened.say)

    def spec(self, opened, provenance):
        graph = opened.artifact("nir")
        confidence = confidence_of(graph)
        return deployed_nir(graph.folder, confidence, self.settings, opened.dataset, provenance)

    def choices(self, recordings):
        if not self.settings.on_events:
            return {}, []
        return presentation_choices(self.settings, recordings)

    def require_fit(self, recordings):
        nir, sensor = self.settings.nir, recordings.sensor
        # A file that has changed is not the run's network; the run's copy is compared when it is
        # read.
        if is_file(nir.file, nir.sha256):
            shape = sensor.rows, sensor.columns, self.channels
            require_fit(read_nir(nir.file), shape, len(sensor.classes), nir.file)

    def require_presentable(self, dataset):
        if not self.settings.on_events:
            require_images_fit(dataset.inputs, self.settings)

    def require_usable(self, opened):
        artifact = opened.artifact("nir")
        if not artifact.state().is_current:
            graph_for(artifact.folder, self.settings, opened.dataset)

    def notes(self, recordings):
        return event_warnings(self.settings, recordings) if self.settings.on_events else []
