"""``stmnist predict``: the classes of recordings, with or without labels."""

from typing import Annotated

import typer

from pipeline.commands import options


def predict(  # noqa: PLR0913 - each is an option of the command
    bundle: options.Bundle,
    data: Annotated[
        str,
        typer.Argument(
            help="Recordings of the network's sensor: one file, or a zip or folder, also without "
            "folders of classes.",
        ),
    ],
    target: Annotated[str, typer.Option(help="As of 'check run', such as nengo.")] = "fast",
    skip_bad: options.SkipBad = False,
    time_unit: options.TimeUnit = "",
    jobs: options.Jobs = 2,
    as_json: options.Json = False,
):
    """Classify recordings, with or without labels: a file, a zip or a folder.

    Prints the class of each recording and the estimated probability that it is right; of a network
    without a confidence estimator, the softmax of its outputs.  Each recording is presented to the
    network at rest.
    """
    from deploy.check.bundle import read_bundle
    from deploy.network.provenance import read_classes
    from pipeline.api.results import Predictions
    from pipeline.results.check_on_others import OtherRecordings
    from pipeline.results.other_recordings import predict_recordings

    folder = options.find_bundle(bundle)
    opened = read_bundle(folder)
    options.warn_if_outdated(folder)
    others = OtherRecordings(data, skip_bad=skip_bad, time_unit=time_unit, jobs=jobs)
    predictions = Predictions(
        predict_recordings(opened, others, target, options.say), read_classes(opened.spec)
    )
    options.print_result(predictions.to_dict(), lambda _: str(predictions), as_json)
