"""The stages of a run: each reads the artifacts of the previous one and runs only if outdated."""

from pipeline.roads.nir_import import refuse_early
from pipeline.roads.nir_settings import settings_of_nir
from pipeline.roads.own_model import settings_of_model
from pipeline.stages.answering import answer, answer_all
from pipeline.stages.bars import bars
from pipeline.stages.bundling import convert, make_bundle, on_test_split, spec_of
from pipeline.stages.opening import open_dataset
from pipeline.stages.training import (
    network_artifact,
    read_weights,
    train,
    train_all,
    weights_of,
)
