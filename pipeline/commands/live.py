"""``stmnist live``: a sensor's skin in the browser."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from deploy.terminal import INTERRUPTED
from pipeline.commands import options
from pipeline.live import PORT, RECORD


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
):
    """Draw on a sensor in the browser, watch the network decide, save the recordings.

    Without RUN the page has a network for digits that is part of this package.  The page is served
    until Ctrl-C, to this machine only unless --host is given.
    """
    from deploy.check.bundle import read_bundle
    from pipeline.live.network import SHIPPED
    from pipeline.live.serving import serve

    try:
        network = partial(read_bundle, options.find_bundle(run or SHIPPED))
        serve(network, port, record, host, not no_browser, options.say)
    except KeyboardInterrupt:  # the usual end
        sys.exit(INTERRUPTED)
