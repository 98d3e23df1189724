"""Tables of numbered taxels: ``LUT.mat`` and ``taxels.csv``.

``LUT.mat`` has the row and column of each taxel in the tactile image, ``taxels.csv`` its position
on the sensor, for drawing.
"""

import csv
import io
from collections import Counter
from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.formats.recording import BadRecording
from pipeline.recordings.sensor import TaxelMap


def read_positions(content: bytes) -> dict:
    """Read ``taxels.csv``: a line ``taxel,x,y`` for each taxel, below a line with these names.

    Returns
    -------
    dict of int to (float, float)
        Position of each taxel: x to the right, y downwards, in any unit.

    Raises
    ------
    BadRecording
        It has other columns or values, or a taxel twice.
    """
    try:
        rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig")), skipinitialspace=True))
        taxels = [int(row["taxel"]) for row in rows]
        positions = [(float(row["x"]), float(row["y"])) for row in rows]
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise BadRecording("is not a table with the columns taxel, x and y in numbers") from error
    doubled = [taxel for taxel, count in Counter(taxels).items() if count > 1]
    if doubled:
        raise BadRecording(f"has taxel {doubled[0]} twice; keep one line of it")
    if not rows or not np.isfinite(positions).all():
        raise BadRecording("has no taxels, or a position that is not finite")
    return dict(zip(taxels, positions, strict=True))


def add_positions(path, taxels: TaxelMap, rows: int, columns: int, positions: dict) -> TaxelMap:
    """Add positions to the taxels of a sensor in one row, which are numbered by x.

    Raises
    ------
    UserError
        The sensor has several rows, or the table other taxels.
    """
    if rows != 1:
        raise UserError(
            f"{path}: taxels.csv is for sensors whose taxels are numbered by x, in one row; these "
            f"recordings have {rows} rows: remove taxels.csv"
        )
    if wrong := sorted(positions.keys() ^ set(range(columns))):
        raise UserError(
            f"{path}: taxels.csv needs a line for each taxel from 0 to {columns - 1} (or "
            f"give --set skin.columns=...), and taxel {wrong[0]} "
            + ("is not one of them" if wrong[0] in positions else "is missing")
        )
    return replace(
        taxels, positions=np.array([positions[taxel] for taxel in range(columns)], float)
    )


def find_table_size(path, lookup: TaxelMap, rows: int, columns: int) -> tuple:
    """Rows and columns of a sensor with a look-up table.

    Parameters
    ----------
    path : path-like
    lookup : TaxelMap
        From ``LUT.mat``.
    rows, columns : int
        As the user states them; 0 for as in the table.

    Raises
    ------
    UserError
        The table has taxels outside of the stated rows and columns.
    """
    extent = int(lookup.row.max()) + 1, int(lookup.column.max()) + 1
    rows = rows or extent[0]
    columns = columns or extent[1]
    if rows < extent[0] or columns < extent[1]:
        raise UserError(
            f"{path}: recordings of a sensor of {extent[0]} x {extent[1]} taxels (LUT.mat), "
            f"larger than {rows} x {columns}; give recordings of a sensor of that size"
        )
    return rows, columns
