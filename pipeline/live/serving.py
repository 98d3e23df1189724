"""The live page of a run or a bundle."""

import contextlib
import threading
import webbrowser
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from deploy.errors import UserError
from deploy.terminal import remark, show
from pipeline.live.network import describe_for_page, find_record_folder, find_sensor
from pipeline.results.status import describe_outdated
from pipeline.simulation import parameters
from pipeline.storage.run_folder import RunFolder, run_around


def serve(
    network: Callable, port: int, record, host: str | None, open_browser: bool = True, say=remark
):
    """Serve the live page of a network until it is interrupted.

    Parameters
    ----------
    network : callable
        Returns the bundle; called when the port is known to be free.
    port : int
        0 for any free one.
    record : path-like, optional
        Folder for the recordings; default: :func:`pipeline.live.network.find_record_folder`.
    host : str, optional
        Address of this machine; default: for this machine only.
    open_browser : bool
    say : callable
        Called with each message.

    Raises
    ------
    UserError
        A package is missing, the port is in use, or the page does not support this network.
    """
    try:
        import segno

        from pipeline.live.keeping import Keeper
        from pipeline.live.server import HOST, Live, Server, listen
    except ImportError as error:
        raise UserError(
            f"the page needs {error.name}: pip install 'stmnist-loihi[live]', or make setup"
        ) from error
    host = host or HOST
    with contextlib.ExitStack() as opened:
        # A port that is in use is reported now, not after the network has been trained.
        listening = opened.enter_context(closing(listen(port, host)))
        bundle = network()
        folder = RunFolder(run_around(bundle.path) or bundle.path.parent)
        sensor = find_sensor(bundle)
        record = Path(record or find_record_folder(bundle, sensor))
        keeper = opened.enter_context(closing(Keeper(record, sensor)))
        note = describe_outdated(bundle.path)
        if note is not None:
            say(note)

        def load_decider():
            from pipeline.live.deciding import make_decider  # Nengo takes a second to import

            return make_decider(bundle, sensor)

        def make_examples():
            from pipeline.live.examples import list_check_examples

            return list_check_examples(folder, bundle)

        def when_listening(url):
            show(f"live: {url}", flush=True)
            if host != HOST:
                segno.make_qr(url, error="m").terminal(compact=True)
            if open_browser:  # in a thread: some browsers return when they are closed
                threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()

        facts = describe_for_page(bundle, sensor, record, note)
        page = Live(
            load_decider, keeper, parameters.read_parameters(), facts, make_examples=make_examples
        )
        try:
            Server(page, listening, when_listening, host).run()
        finally:
            say(f"live: ended; {len(keeper)} recordings are saved in {record}")
