"""``stmnist check``: the 200-sample check."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy import limits
from deploy.check.bundle import read_bundle, result_beside
from deploy.check.results import compare_results, enforce, loss_text, read_result, require_limits
from deploy.check.run import run_check
from deploy.check.text import comparison_text, others_text, summary
from deploy.errors import UserError
from deploy.files import write_json
from deploy.targets.board import BoardOptions
from deploy.targets.registry import TARGETS, options_for
from pipeline.commands import options
from pipeline.progress import progress
from pipeline.run.answers import REFERENCES
from pipeline.settings import Settings, read_settings

BOARD = {"rich_help_panel": "Target loihi"}


def run(
    bundle: options.Bundle,
    target: Annotated[
        str,
        typer.Option(help=f"One of {', '.join(TARGETS)}.", autocompletion=lambda: list(TARGETS)),
    ],
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="The result (default: checks/TARGET.json beside the bundle)."),
    ] = None,
    seed: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Seed given to the simulator (default: that of the bundle's run)."),
    ] = None,
    data: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Other recordings, zip or folder, instead of the bundle's samples; sensor "
            "and classes must be the same."
        ),
    ] = None,
    samples: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            help="With --data: recordings drawn at random; 0 for all (default: 200 at most).",
            parser=options.between(0, limits.SAMPLES),
        ),
    ] = None,
    jobs: options.Jobs = 2,
    board: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Name of a board (default: the cluster's choice).", **BOARD),
    ] = None,
    partition: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="SLURM partition (default: the board is on this host).", **BOARD),
    ] = None,
    chips: Annotated[
        int, typer.Option(help="Largest number of chips to use.", **BOARD)
    ] = BoardOptions.chips,
    attempts: Annotated[
        int, typer.Option(help="Largest number of attempts for each stream.", **BOARD)
    ] = BoardOptions.attempts,
    wait: Annotated[
        float,
        typer.Option(help="Seconds before the second attempt, then twice as long.", **BOARD),
    ] = BoardOptions.wait,
    timeout: Annotated[
        float,
        typer.Option(help="Seconds after which a stream that hangs is abandoned.", **BOARD),
    ] = BoardOptions.timeout,
    energy: Annotated[
        bool, typer.Option("--energy", help="Measure power if the board can.", **BOARD)
    ] = False,
    as_json: options.Json = False,
):
    """Let a target answer the bundle's samples; an interrupted check goes on where it stopped."""
    chosen = options_for(
        target,
        board=board,
        partition=partition,
        chips=chips,
        attempts=attempts,
        wait=wait,
        timeout=timeout,
        energy=energy,
    )
    if samples is not None and data is None:
        raise UserError("--samples: of other recordings only; name them with --data FILE")
    bundle = options.bundle_in(bundle)
    opened = read_bundle(bundle)
    options.warn_if_outdated(bundle)
    if seed is None:
        seed = opened.spec.provenance.get("seed", 0)
    if data is not None:
        _on_others(opened, target, data, samples, seed, jobs, out, chosen, as_json)
        return
    path = out or result_beside(opened.path.absolute().parent, target)
    with progress(f"check {target}", len(opened.checks)) as advance:
        result = run_check(opened, target, path, seed, advance, chosen)
    options.tell(result, lambda value: f"{summary(value)}\nwritten to {path}", as_json)
    if loss := _loss(opened, result):
        options.say(f"check: {loss}")


def _loss(bundle, result):
    """What is lost against the network that the bundle was made from, where its answers are."""
    for first, *_ in REFERENCES.values():
        with contextlib.suppress(UserError):  # none there, or damaged: then there is nothing to say
            reference = read_result(bundle.path.absolute().parent / "checks" / f"{first}.json")
            if reference["bundle"] == bundle.id:
                return loss_text(reference, result)
    return None


def _on_others(bundle, target, data, samples, seed, jobs, out, chosen, as_json):
    """The check on other recordings than the bundle's own."""
    from pipeline.run import elsewhere  # with what reads recordings

    experiment = bundle.path.absolute().parent / "experiment.toml"
    settings = read_settings(experiment) if experiment.exists() else Settings()
    recordings = elsewhere.recordings_for(bundle, data, settings, jobs, options.say)
    shown, indices = elsewhere.shown_instead(bundle, recordings, samples, seed, settings.image)
    path = out or elsewhere.result_path(bundle, recordings, len(indices), target)
    with progress(f"check {target}", len(indices)) as advance:
        result = run_check(shown, target, path, seed, advance, chosen)
    result = elsewhere.told_of(result, recordings, indices)
    write_json(path, result)
    options.tell(result, lambda value: f"{others_text(value)}\nwritten to {path}", as_json)


def compare_checks(
    a: Annotated[Path, typer.Argument(help="A result, JSON.")],
    b: Annotated[Path, typer.Argument(help="Another result of the same bundle.")],
    max_disagreements: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Exit with status 1 if more predictions differ."),
    ] = None,
    max_accuracy_drop: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="Exit with status 1 if B is less accurate by more than this."),
    ] = None,
    as_json: options.Json = False,
):
    """Compare two results: agreement, McNemar's test, the first samples that differ."""
    require_limits(max_disagreements, max_accuracy_drop)
    comparison = compare_results(read_result(a), read_result(b))
    options.warn_if_outdated(a, b)
    options.tell(comparison.to_json(), lambda _: comparison_text(comparison), as_json)
    enforce(comparison, max_disagreements, max_accuracy_drop)
