"""Files in which the taxels are numbered: spiketrain matrices, and arrays of counts in bins."""

import math
from collections import Counter

from deploy.errors import UserError
from pipeline.recordings.interpretation import binned_counts
from pipeline.recordings.interpretation.interpretation import (
    GIVE_SIZE,
    Interpretation,
    refuse_two_sensors,
)
from pipeline.recordings.interpretation.taxel_tables import find_table_size
from pipeline.recordings.sensor import N_TAXELS, TaxelMap


def interpret_numbered(path, recordings, parts, lookup, is_strip, options) -> Interpretation:
    """Interpret recordings with numbered taxels.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
    parts : list of str
        Part of the published split of each, or empty.
    lookup : TaxelMap or None
        Row and column of each taxel.
    is_strip : bool
        True if the taxels are in one row, even if they could fill a square.
    options : ReadingOptions

    Raises
    ------
    UserError
        Rows and columns cannot be determined, or differ between train and test; or the time or
        the channel of counts is not valid.
    """
    has_bins = recordings[0].bins is not None
    n_taxels, refused = _find_number_of_taxels(path, recordings, parts, lookup)
    if has_bins:
        refused |= binned_counts.find_other_shapes(recordings)
    kept = [index for index in range(len(recordings)) if index not in refused]
    recordings = [recordings[index] for index in kept]
    if lookup is not None:
        rows, columns = find_table_size(path, lookup, options.rows, options.columns)
        taxels = lookup
    else:
        rows, columns = _arrange_taxels(path, n_taxels, has_bins, is_strip, options)
        taxels = TaxelMap.grid(rows, columns)
    if has_bins:
        without_events = Interpretation(kept, [], refused, taxels, rows, columns)
        return binned_counts.add_events(path, without_events, recordings, options)
    events = [recording.to_numbered_events() for recording in recordings]
    return Interpretation(kept, events, refused, taxels, rows, columns)


def _find_number_of_taxels(path, recordings, parts, lookup):
    """The number of taxels, and the recordings that have another one, each with the reason."""
    by_part = {}
    for recording, part in zip(recordings, parts, strict=True):
        by_part.setdefault(part, Counter())[recording.n_taxels] += 1
    of_part = {part: numbers.most_common(1)[0][0] for part, numbers in by_part.items()}
    if len(set(of_part.values())) > 1:
        refuse_two_sensors(path, {part: f"{n_taxels} taxels" for part, n_taxels in of_part.items()})
    if lookup is None:
        n_taxels = next(iter(of_part.values()))
        authority = "most have"
    else:
        n_taxels = len(lookup)
        authority = "LUT.mat says"
    refused = {
        index: f"has {recording.n_taxels} taxels, not {n_taxels} as {authority}"
        for index, recording in enumerate(recordings)
        if recording.n_taxels != n_taxels
    }
    return n_taxels, refused


def _arrange_taxels(path, n_taxels, has_bins, is_strip, options):
    """Rows and columns of numbered taxels without a look-up table."""
    rows = options.rows
    columns = options.columns
    if not rows and not columns:
        side = math.isqrt(n_taxels)
        is_square = n_taxels == N_TAXELS if has_bins else side * side == n_taxels
        rows = side if is_square and not is_strip else 1
    rows = rows or max(n_taxels // columns, 1)
    columns = columns or max(n_taxels // rows, 1)
    if rows * columns != n_taxels:
        raise UserError(
            f"{path}: the recordings have {n_taxels} taxels, not {rows} rows of {columns}; give "
            "recordings of that sensor, add LUT.mat, or give the numbers of rows and columns: "
            f"{GIVE_SIZE}"
        )
    return rows, columns
