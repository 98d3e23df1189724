"""Which polarity comes first, and which taxels fire in how many recordings and for how long.

A *hot* taxel fires all the time, whatever touches the sensor.  A network that has not seen it in
its training may fail (``check run --fault``), and it shrinks a tactile image that is divided by its
maximum.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.recordings.recordings import Recordings

# Equal slices of a recording, from its first event to its last, in which a taxel fires or not.
SLICES = 20

# Share of the slices from which a taxel fires throughout a recording.
MIN_THROUGHOUT_SHARE = 0.8

# A hot taxel fires throughout at least this share of all recordings; and of the recordings in which
# it fires, throughout as many times more than the median taxel.
MIN_HOT_SHARE = 0.01
MIN_HOT_FACTOR = 5.0

# Hot taxels that are printed.
MAX_LISTED = 8

# From how many times as many taxels with the fall first as with the rise first on, the polarities
# may be exchanged.  Where both are as frequent, their order says nothing.
MIN_EXCHANGED_RATIO = 1.5


@dataclass(frozen=True)
class TaxelActivity:
    """Activity of each taxel, as shares from 0 to 1, shape (n_taxels,).

    Attributes
    ----------
    recordings : ndarray
        Share of the recordings in which the taxel fires.
    extent : ndarray
        Mean share of the slices of these recordings in which it fires; 0 if it never fires.
    throughout : ndarray
        Share of all recordings of which it fires in at least 80 % of the slices.
    """

    recordings: np.ndarray
    extent: np.ndarray
    throughout: np.ndarray


def measure_activity(recordings: Recordings) -> TaxelActivity:
    """Measure in how many recordings each taxel fires, and for how much of their time."""
    n_taxels = len(recordings.taxels)
    n = len(recordings)
    events = recordings.events
    sample = recordings.sample_of_event
    offsets = recordings.offsets
    first = np.zeros(n, np.int64)
    span = np.ones(n, np.int64)
    with_events = np.flatnonzero(np.diff(offsets))
    first[with_events] = events.time_ns[offsets[with_events]]
    span[with_events] = events.time_ns[offsets[with_events + 1] - 1] - first[with_events] + 1
    slices = (events.time_ns - first[sample]) * SLICES // span[sample]
    pair = sample * n_taxels + events.taxel
    fires = np.unique(pair * SLICES + slices) // SLICES
    pairs, number = np.unique(fires, return_counts=True)
    taxel = pairs % n_taxels
    share = number / SLICES
    in_recordings = np.bincount(taxel, minlength=n_taxels)
    extent = np.bincount(taxel, share, n_taxels) / np.maximum(in_recordings, 1)
    is_throughout = share >= MIN_THROUGHOUT_SHARE
    throughout = np.bincount(taxel[is_throughout], minlength=n_taxels)
    return TaxelActivity(in_recordings / max(n, 1), extent, throughout / max(n, 1))


def find_hot_taxels(activity: TaxelActivity) -> list:
    """Find taxels that, once they fire, fire throughout a recording far more often than the others.

    Where all taxels do so, as in a grasp or a press of the whole recording, none is hot.

    Returns
    -------
    list of int
        Indices of the taxels, those that fire throughout most recordings first.
    """
    fires = activity.recordings > 0
    if not fires.any():
        return []
    share = activity.throughout / np.where(fires, activity.recordings, 1)
    is_often = activity.throughout >= MIN_HOT_SHARE
    is_unusual = share >= MIN_HOT_FACTOR * np.median(share[fires])
    hot = np.flatnonzero(is_often & is_unusual)
    return hot[np.argsort(-activity.throughout[hot], kind="stable")].tolist()


def make_activity_json(recordings: Recordings) -> dict:
    """:func:`measure_activity` and the hot taxels as plain values; rows and columns from 0."""
    activity = measure_activity(recordings)
    taxels = recordings.taxels
    each = [
        {
            "taxel": index,
            "row": int(taxels.row[index]),
            "column": int(taxels.column[index]),
            "recordings": float(activity.recordings[index]),
            "extent": float(activity.extent[index]),
            "throughout": float(activity.throughout[index]),
        }
        for index in range(len(taxels))
    ]
    return {"hot": find_hot_taxels(activity), "each": each}


def format_activity(recordings: Recordings) -> str:
    """:func:`measure_activity` and the hot taxels in a few lines."""
    activity = measure_activity(recordings)
    taxels = recordings.taxels
    fires = activity.recordings > 0
    if not fires.any():
        return "taxels: none fires"
    shares = 100 * activity.recordings[fires]
    lines = [
        f"taxels: {fires.sum()} of {len(taxels)} fire; a taxel fires in {shares.min():.0f} to "
        f"{shares.max():.0f} % of the recordings (median {np.median(shares):.0f} %), and through "
        f"{100 * np.median(activity.extent[fires]):.0f} % of the time of such a recording (median)"
    ]
    hot = find_hot_taxels(activity)
    lines.append(
        "hot taxels, which fire throughout many recordings (through 80 % of the time or more, as "
        f"under a long press too): {len(hot) or 'none'}"
    )
    lines += [
        f"  taxel {index} (row {taxels.row[index]}, column {taxels.column[index]}, from 0): "
        f"fires throughout {100 * activity.throughout[index]:.1f} % of the recordings, and in "
        f"{100 * activity.recordings[index]:.0f} % at all"
        for index in hot[:MAX_LISTED]
    ]
    if len(hot) > MAX_LISTED:
        lines.append(f"  and {len(hot) - MAX_LISTED} more (--json has all)")
    return "\n".join(lines)


def measure_polarity_order(recordings: Recordings) -> dict:
    """Which polarity comes first on the taxels of each recording.

    A taxel that is not touched can only rise: where the fall comes first on most taxels, the
    polarities are exchanged.

    Returns
    -------
    dict
        ``taxels``: number of taxels, summed over recordings, with events of both polarities;
        ``rise_first``, ``fall_first``, ``together``: shares of them, None if there are none.
    """
    events = recordings.events
    pair = recordings.sample_of_event * len(recordings.taxels) + events.taxel
    is_rise = events.polarity > 0
    rise, first_rise = np.unique(pair[is_rise], return_index=True)
    fall, first_fall = np.unique(pair[~is_rise], return_index=True)
    _, in_rise, in_fall = np.intersect1d(rise, fall, assume_unique=True, return_indices=True)
    rises = events.time_ns[is_rise][first_rise[in_rise]]
    falls = events.time_ns[~is_rise][first_fall[in_fall]]
    shares = (rises < falls, rises > falls, rises == falls)
    names = ("rise_first", "fall_first", "together")
    return {
        "taxels": len(rises),
        **{
            name: float(share.mean()) if len(rises) else None
            for name, share in zip(names, shares, strict=True)
        },
    }


def format_polarity_order(order: dict) -> str:
    """:func:`measure_polarity_order` in a line."""
    if not order["taxels"]:
        return "polarity: no taxel has events of both polarities"
    text = (
        f"polarity: the rise comes first on {100 * order['rise_first']:.1f} % of the "
        f"{order['taxels']} taxels of recordings with both polarities, the fall on "
        f"{100 * order['fall_first']:.1f} %, both at once on {100 * order['together']:.1f} %"
    )
    if order["fall_first"] > MIN_EXCHANGED_RATIO * order["rise_first"]:
        text += "; a taxel at rest can only rise, so the polarities may be exchanged"
    return text
