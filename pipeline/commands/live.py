"""``stmnist live``: the skin in the browser."""

from __future__ import annotations

import threading
import webbrowser
from contextlib import closing
from pathlib import Path
from typing import Annotated, Optional

import typer

from deploy.errors import UserError
from deploy.terminal import show
from pipeline.commands import options
from pipeline.live.network import (
    SHIPPED,
    about,
    fits_the_page,
    network_of_bundle,
    network_of_run,
)
from pipeline.run import stages
from pipeline.run.folder import RunFolder
from pipeline.run.status import outdated_note
from pipeline.skin import parameters

PORT = 8765
RECORD = Path("written")
DEFAULT_RUN = Path("runs/default")


def live(
    run: Annotated[
        Optional[Path],  # noqa: UP045 - Typer reads the annotation at run time
        typer.Argument(
            help="Folder of a run, or of a copied bundle.",
            show_default="the network on events that comes with this package",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(help="Port of this machine; 0 for any free one.", min=0, max=65535)
    ] = PORT,
    record: Annotated[
        Path, typer.Option(help="Folder for the recordings; usable as DATA.")
    ] = RECORD,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print the address.")
    ] = False,
    data: options.Data = None,
    kind: options.Input = None,
    seed: options.Seed = None,
    settings: options.SettingsFile = None,
    set_: options.Assignments = None,
    jobs: options.Jobs = 2,
):
    """Write digits in the browser, watch the network decide, save the recordings.

    Without a run it begins at once, with a network that comes with this package.  A run that is not
    there is trained first.  Serves on 127.0.0.1 only, until Ctrl-C.
    """
    try:
        from pipeline.live.keeping import Keeper
        from pipeline.live.server import Live, Server, listen
    except ImportError as error:
        raise UserError(
            f"the page needs {error.name}: pip install 'stmnist-loihi[live]', or make setup"
        ) from error
    # Said now, not when the network is trained: a folder or a port that is in use.
    with closing(Keeper(record)) as keeper, closing(listen(port)) as listening:
        bundle, image = _network(run, data, kind, seed, settings, set_, jobs)
        fits_the_page(bundle)
        note = outdated_note(bundle.path)
        if note is not None:
            options.say(note)

        def make_decider():
            from pipeline.live.deciding import decider_of  # Nengo: a second that the page can spare

            return decider_of(bundle, image)

        def make_learner():
            from pipeline.live.learning import Learner

            return Learner.of(bundle, image, record)

        def opened(url):
            show(f"live: {url}", flush=True)
            if not no_browser:  # in a thread: some browsers return when they are closed
                threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

        try:
            told = about(bundle, record, note)
            page = Live(make_decider, keeper, parameters.load(), told, make_learner=make_learner)
            Server(page, listening, opened).run()
        finally:
            options.say(f"live: ended; {len(keeper)} recordings are kept in {record}")


def _network(run, data, kind, seed, settings, set_, jobs):
    """The bundle, made if it is not there or otherwise asked for, and how events become images."""
    asked = any((data, kind, seed is not None, settings, set_))
    if run is None:
        run = DEFAULT_RUN if asked else SHIPPED
    if found := network_of_bundle(run):
        return found
    folder = RunFolder(run)
    if not asked and (found := network_of_run(folder)):
        return found
    if not folder.bundle.exists():
        options.say(f"live: {run} has no network yet; training it first, about a minute")
    given = (data, seed, None, None, settings, set_, kind)
    fit = options.fit_recordings(jobs)
    with options.opened(run, *given, fit=fit) as (folder, resolved):
        _, bundle = stages.make_bundle(folder, resolved, jobs, options.say)
    return bundle, resolved.image
