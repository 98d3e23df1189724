"""The order of columns without names: x, y, t, p; or t, x, y, p; or x, y, p, t.

Times rise from line to line, coordinates are whole numbers, and polarities have two values.  In a
short recording the numbers may fit several orders; then the other recordings of the source decide,
and then the times, which have more values than coordinates that rise, too.
"""

from dataclasses import replace

import numpy as np

from pipeline.recordings.formats.recording import (
    MAX_PLACE,
    BadRecording,
    EventRecording,
    make_recording,
)

# The documented order is the first.
ORDERS = ("xytp", "txyp", "xypt")

# Orders that are not read, and that cannot be told from these if x has two values.
WITH_POLARITY_FIRST = {"txyp": "tpxy", "xypt": "pxyt"}

NAME_COLUMNS = "write the names of the columns in the first line, such as t,x,y,p"


def make_array_recording(array: np.ndarray) -> EventRecording:
    """Turn an array of a file into a recording; its columns may have no names.

    Parameters
    ----------
    array : ndarray
        Structured, or of shape (n_events, 4) in one of :data:`ORDERS`.

    Returns
    -------
    EventRecording
        With ``orders`` if the columns have no names, and ``table`` if there are several.

    Raises
    ------
    BadRecording
        See :func:`pipeline.recordings.formats.recording.make_recording`; or the columns fit none of
        the orders.
    """
    if array.dtype.names or array.ndim != 2 or array.shape[1] != len(ORDERS[0]) or not len(array):
        return make_recording(array)
    orders = _find_orders(array)
    if not orders:
        try:
            make_recording(array)  # refuses values that are wrong in the documented order
        except BadRecording as error:
            reason = f"{error}; or, as columns have no names, {NAME_COLUMNS}"
            raise BadRecording(reason, error.event) from error
        raise BadRecording(
            "has four columns without names, and times that rise in none of the orders "
            f"{', '.join(ORDERS)}; {NAME_COLUMNS}"
        )
    table = array if len(orders) > 1 else None
    return replace(_make_table_recording(array, orders[0]), orders=orders, table=table)


def settle_orders(recordings) -> tuple:
    """Read the recordings of a source whose columns have no names in an order that all can have.

    Parameters
    ----------
    recordings : sequence of EventRecording
        From :func:`make_array_recording` and other functions.

    Returns
    -------
    list of EventRecording, str
        The recordings, without tables, and their order; an empty text if all columns have names.

    Raises
    ------
    BadRecording
        No order fits all recordings, or it cannot be told from another one.
    """
    tables = [recording for recording in recordings if recording.orders]
    if not tables:
        return list(recordings), ""
    possible = set(ORDERS).intersection(*(recording.orders for recording in tables))
    common = [order for order in ORDERS if order in possible]
    if not common:
        raise BadRecording(
            f"recordings have four columns without names, and not all in one order; {NAME_COLUMNS}"
        )
    order = max(common, key=lambda order: _count_times(tables, order))  # the first of equal ones
    _refuse_two_polarities(tables, order)
    return [_put_in_order(recording, order) for recording in recordings], order


def _refuse_two_polarities(tables, order):
    """Refuse recordings whose x may as well be the polarity, as in the order t, p, x, y.

    A single recording may be from the edge of a larger sensor.
    """
    alternative = WITH_POLARITY_FIRST.get(order)
    if alternative is None or len(tables) == 1:
        return
    if all(_put_in_order(recording, order).x.max() <= 1 for recording in tables):
        raise BadRecording(
            "recordings have four columns without names, of which two have only 0 and 1: their "
            f"order may be {', '.join(order)} or {', '.join(alternative)}; {NAME_COLUMNS}"
        )


def _count_times(recordings, order):
    """Number of different times that recordings have in an order; 0 if it is their only one."""
    tables = [recording.table for recording in recordings if recording.table is not None]
    return sum(_count_times_in(table, order) for table in tables)


def _count_times_in(table, order):
    return len(np.unique(table[:, order.index("t")]))


def _put_in_order(recording, order):
    if not recording.orders:
        return recording
    if recording.orders[0] == order:
        return replace(recording, orders=(), table=None)
    return _make_table_recording(recording.table, order)


def _make_table_recording(table, order):
    return make_recording(dict(zip(order, table.T, strict=True)))


def _find_orders(table) -> tuple:
    """The orders that a table of four columns can have, that with the most times first."""
    if not np.isfinite(table).all():
        return ()
    is_time = (np.diff(table, axis=0) >= 0).all(axis=0)
    is_place = ((table >= 0) & (table <= MAX_PLACE) & (table == np.floor(table))).all(axis=0)
    is_polarity = np.isin(table, (-1, 0, 1)).all(axis=0)
    fits = {"t": is_time, "x": is_place, "y": is_place, "p": is_polarity}
    possible = [order for order in ORDERS if _is_possible(order, fits)]
    return tuple(sorted(possible, key=lambda order: -_count_times_in(table, order)))


def _is_possible(order, fits):
    """True if each column can be what it is called in an order."""
    return all(fits[name][index] for index, name in enumerate(order))
