"""Interpret recordings by the layout that most of their files have.

Recordings in the published layout with a hundred taxels and digits as classes are treated as
ST-MNIST's: they have its ten classes and its two seconds, independently of their content.  For all
others these are inferred from the recordings, unless the user specifies rows and columns.
"""

from collections import Counter
from dataclasses import replace

from pipeline.recordings.interpretation.coordinates import interpret_coordinates
from pipeline.recordings.interpretation.interpretation import Interpretation, renumber_doubts
from pipeline.recordings.interpretation.numbered import interpret_numbered
from pipeline.recordings.interpretation.options import AS_FOUND
from pipeline.recordings.interpretation.taxel_tables import add_positions

# What each layout of a file is called; see EventRecording.layout.
LAYOUT_NAMES = {
    "events": "a list of events",
    "numbered": "a spiketrain",
    "bins": "an array of counts",
}


def interpret_recordings(
    path, recordings, parts, lookup=None, positions=None, options=AS_FOUND
) -> Interpretation:
    """Determine the sensor of recordings that were read one by one, and their events on it.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
    parts : list of str
        ``"train"`` or ``"test"`` in a published split, or empty.
    lookup : TaxelMap, optional
        Row and column of each taxel in the image, from ``LUT.mat``.
    positions : dict of int to (float, float), optional
        Positions of the taxels on the sensor, from ``taxels.csv``.
    options : ReadingOptions

    Raises
    ------
    UserError
        Rows, columns or the unit of time cannot be determined, or differ between train and test.
    """
    layouts = [recording.layout for recording in recordings]
    layout = Counter(layouts).most_common(1)[0][0]
    selected = [index for index, each in enumerate(layouts) if each == layout]
    recordings = [recordings[index] for index in selected]
    parts = [parts[index] for index in selected]
    if layout == "events":
        partial = interpret_coordinates(path, recordings, parts, lookup, options)
    else:
        is_strip = positions is not None
        partial = interpret_numbered(path, recordings, parts, lookup, is_strip, options)
    refused = {selected[index]: reason for index, reason in partial.refused.items()}
    for index, other in enumerate(layouts):
        if other != layout:
            names = LAYOUT_NAMES[other], LAYOUT_NAMES[layout]
            refused[index] = "is {}, unlike most others: {}".format(*names)
    taxels = partial.taxels
    if positions is not None:
        taxels = add_positions(path, taxels, partial.rows, partial.columns, positions)
    return replace(
        partial,
        kept=[selected[index] for index in partial.kept],
        refused=refused,
        doubts=renumber_doubts(partial.doubts, selected),
        taxels=taxels,
    )
