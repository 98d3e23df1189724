"""Measure a case of an experiment: what a study measures, and what only experiments have.

These are stages, and splits that hold out styles of writing.
"""

from dataclasses import replace

from experiments import classifiers, readings
from experiments.catalogue import FAULTY_STAGES
from experiments.styles import STYLES, hold_out_styles
from experiments.variants import VARIANTS, vary_dataset
from pipeline import paper
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.faulty_taxels import add_faults
from pipeline.results import study
from pipeline.results.study import Case
from pipeline.storage.artifacts import Library


def measure(case: Case, networks: Library) -> dict:
    """As :func:`pipeline.results.study.measure_case`, with the stages and splits of experiments."""
    if case.split == STYLES:
        case = replace(case, split="random")
        row = _measure_on(hold_out_styles(study.make_dataset(case), case.seed), case, networks)
        return {**row, "split": STYLES}
    return _measure_on(study.make_dataset(case), case, networks)


def _measure_on(dataset, case, networks):
    if case.alter in VARIANTS:
        dataset = vary_dataset(dataset, case.alter, case.seed)
    index = dataset.split.get_indices(case.part)
    if case.stage == readings.STAGE:
        predictions = readings.predict_test_samples(dataset, index, case.alter, case.resolved)
        return study.make_row(case, dataset, index, predictions)
    if case.stage in classifiers.STAGES:
        predictions = classifiers.predict_test_samples(dataset, index, case.stage)
        return study.make_row(case, dataset, index, predictions)
    if case.stage == "fast-200":
        return _draw_check_samples(
            study.measure_case(replace(case, stage="fast"), networks, dataset), dataset, case
        )
    if case.stage in FAULTY_STAGES:
        return _measure_with_faults(dataset, case, networks)
    if case.stage not in ("slayer", "slayer-small"):
        return study.measure_case(case, networks, dataset)
    from experiments.slayer import train_and_predict

    scale = 10.0 if case.stage == "slayer-small" else 100.0
    checkpoint = networks.path / case.stage / f"{case.split}-{case.seed:02d}.npz"
    predictions, history = train_and_predict(dataset, index, case.seed, scale, checkpoint)
    return study.make_row(case, dataset, index, predictions, history=history)


def _measure_with_faults(dataset, case, networks):
    """A row of a network on the emulated chip, with faulty taxels in its test samples."""
    on_chip = replace(case, stage="fast")
    opened = study.train_case(on_chip, networks, dataset)
    faults = FAULTY_STAGES[case.stage]
    faulty = add_faults(dataset.recordings, faults, [case.seed, 0xFA])
    tested = Dataset(faulty, dataset.split, dataset.origin, dataset.settings)
    row = study.evaluate_case(on_chip, opened, tested)
    return {**row, "stage": case.stage}


def _draw_check_samples(row, dataset, case):
    """A row of all test samples, reduced to those of a check, as many as the paper has."""
    number = min(paper.CHECK_SAMPLES, len(dataset.split.test))
    drawn = dataset.split.draw_check_samples(number, case.seed).tolist()
    index_of_sample = {sample: index for index, sample in enumerate(row["samples"])}
    indices = [index_of_sample[sample] for sample in drawn]
    right = [row["right"][index] for index in indices]
    return {
        **row,
        "predictions": [row["predictions"][index] for index in indices],
        "right": right,
        "samples": drawn,
        "stage": case.stage,
        "accuracy": sum(right) / len(drawn),
    }
