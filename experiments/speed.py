"""The speed of ``fast`` and of FastSimulator relative to NengoLoihi's emulator.

Both run in turns in one process, and each turn gives one ratio of processor time, because other
work on the machine slows down both.  Building and compiling are left out of the reference, and the
answers of both must be identical.
"""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.errors import CheckFailed
from deploy.files import write_json
from deploy.network.build import build
from deploy.network.loihi_import import nengo_loihi
from deploy.network.responses import respond
from deploy.tables import aligned
from deploy.targets.fast import Emulation
from deploy.targets.registry import answer
from experiments.studies import RESULTS, Store, processor
from fastloihi import speed as networks
from pipeline.commands import options
from pipeline.progress import progress

SEED = 5


def _spent(function, *arguments):
    """The processor time that a call takes, and its result."""
    begun = time.process_time()
    result = function(*arguments)
    return time.process_time() - begun, result


def of_bundle(bundle, samples: int | None = None) -> dict:
    """Run NengoLoihi's emulator and ``fast`` in turns, a stream of a bundle's samples in each.

    Parameters
    ----------
    bundle : Bundle
    samples : int, optional
        Number of samples to use, from the first on.

    Returns
    -------
    dict
        ``identical``, and the medians over turns of the ``ratio`` of processor times per sample and
        of the samples a second of both.  ``fast`` runs all streams of equal length at once.
    """
    spec, inputs = bundle.spec, bundle.checks.inputs[:samples]
    parts = spec.presentation.streams(len(inputs))
    found, emulation = answer(spec, inputs, "fast", SEED), Emulation(spec, SEED)
    whole = [part for part in parts if part.stop - part.start == parts[0].stop]
    streams = np.stack([spec.fed(inputs[part]) for part in whole])
    n_streamed = len(whole) * parts[0].stop
    paces, identical = [], True
    with progress("speed", len(inputs)) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for part in parts:
            built, shown = build(spec), spec.fed(inputs[part])
            with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:
                slow, expected = _spent(respond, spec, built, sim, shown)
            quick, _ = _spent(emulation.run, streams)
            identical &= np.array_equal(expected.decisions, found.decisions[part])
            identical &= np.array_equal(expected.spike_hashes, found.spike_hashes[part])
            paces.append([len(shown) / slow, n_streamed / quick])
            advance(len(shown))
    reference, fast = np.array(paces).T
    return {
        "identical": bool(identical),
        "ratio": float(np.median(fast / reference)),
        "samples_per_second": [float(np.median(reference)), float(np.median(fast))],
        "n_samples": len(inputs),
        "turns": len(parts),
        "simulated": spec.provenance.get("simulated"),
    }


def cells(found: dict) -> list:
    """The rows of a result as lists of text, the heads first."""
    lines = [["", "times as fast", "identical", "samples a second"]]
    for name, row in found["bundles"].items():
        slow, fast = row["samples_per_second"]
        identical = "yes" if row["identical"] else "NO"
        paces = f"{slow:.0f}, {fast:.0f}"
        lines.append([f"fast, {name}", f"{row['ratio']:.0f}x", identical, paces])
    for row in found["networks"]:
        identical = "yes" if row["identical"] else "NO"
        ratio = f"{row['ratio_emulator']:.0f}x"
        lines.append([f"FastSimulator, {row['network']}", ratio, identical, ""])
    return lines


def main(
    bundles: Annotated[
        Optional[list[Path]],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Argument(help="Folders of bundles or runs (default: only networks)."),
    ] = None,
    samples: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Use only the first samples of each bundle's check.", min=1),
    ] = None,
    store: Store = "",
    as_json: options.Json = False,
):
    """Measure how many times as fast as NengoLoihi's emulator fast and FastSimulator are."""
    found = {"experiment": "speed", "bundles": {}, "measured": {"processor": processor()}}
    for path in bundles or ():
        bundle = read_bundle(options.bundle_in(path))
        found["bundles"][bundle.spec.stimulus.kind] = of_bundle(bundle, samples)
    found["networks"] = networks.measure()["rows"]
    if store:
        write_json(RESULTS / f"{store}.json", found)
    title = "Processor time relative to NengoLoihi's emulator, medians of turns"
    options.tell(found, lambda value: "\n".join([title, *aligned(cells(value))]), as_json)
    if not all(row["identical"] for row in (*found["bundles"].values(), *found["networks"])):
        raise CheckFailed("the answers differ from those of NengoLoihi's emulator")
