"""The stages of a run: each reads the artifacts of the previous one and runs only if outdated."""

from pipeline.run.nir_import import refuse_early
from pipeline.run.nir_settings import settings_of_nir
from pipeline.run.nir_training import settings_of_retrained
from pipeline.run.stages.answering import answer, answer_all
from pipeline.run.stages.bars import bars
from pipeline.run.stages.bundling import convert, make_bundle, on_test_split, spec_of
from pipeline.run.stages.opening import open_dataset
from pipeline.run.stages.own_model import read_model, settings_of_model
from pipeline.run.stages.training import (
    network_artifact,
    read_weights,
    train,
    train_all,
    weights_of,
)
