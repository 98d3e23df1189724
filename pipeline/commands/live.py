"""``stmnist live``: a sensor's skin in the browser."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.terminal import INTERRUPTED
from pipeline.commands import options
from pipeline.live import PORT, RECORD

DEFAULT_RUN = Path("runs/default")


def live(
    run: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of a run, or of a copied bundle.",
            show_default="the network on events of this package",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(help="Port of this machine; 0 for any free one.", min=0, max=65535)
    ] = PORT,
    record: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the recordings, which can be given as --data.",
            show_default=f"{RECORD}; for data other than digits, {RECORD}-NAME",
        ),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            help="Address of this machine at which others can open the page, with the token that "
            "is printed.",
            show_default="127.0.0.1, for this machine only",
        ),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print the address.")
    ] = False,
    *,
    requested: options.TrainingRequested,
    jobs: options.Jobs = 2,
):
    """Draw on a sensor in the browser, watch the network decide, save the recordings.

    Without RUN the page starts at once, with a network for digits that is part of this package.  A
    run that does not exist is trained first.  The page is served until Ctrl-C, to this machine only
    unless --host is given.
    """
    from pipeline.live.serving import serve

    try:
        bundle = partial(_network, run, requested, jobs)
        serve(bundle, port, record, host, not no_browser, options.say)
    except KeyboardInterrupt:  # the usual end
        sys.exit(INTERRUPTED)


def _network(run, requested, jobs):
    """The bundle, made if it is missing or if settings were requested."""
    from pipeline.live.network import SHIPPED, network_in
    from pipeline.stages import convert

    asked = requested != options.Requested()
    if run is None:
        run = DEFAULT_RUN if asked else SHIPPED
    if asked and (run / "MANIFEST.json").exists():
        raise UserError(
            f"{run}: is a bundle, whose settings are fixed; leave out --data, --input, --seed, "
            "--settings and --set, or give a run"
        )
    if (network := network_in(run)) is not None and not asked:
        return network
    if network is None:
        options.say(f"live: {run} has no network yet; training it first, about a minute")
    with options.opened(run, requested, jobs) as opened:
        return convert(opened)
