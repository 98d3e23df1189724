"""Rows and columns of the sensor of files of events, whose events have coordinates."""

from dataclasses import dataclass

from deploy.arithmetic import divide_up
from deploy.errors import UserError
from deploy.tables import format_count
from pipeline.recordings.formats.recording import MAX_SIDE
from pipeline.recordings.interpretation.options import ReadingOptions
from pipeline.recordings.interpretation.strays import find_strays

# For axis 0 and 1 of a size: the coordinate in files, and its name for several taxels.
AXES = (("y", "rows"), ("x", "columns"))


@dataclass(frozen=True)
class SensorSize:
    """Rows and columns of a sensor.

    Attributes
    ----------
    rows, columns : int
    doubts : tuple of (tuple of int, str)
        Indices of recordings that alone make the sensor as large, and what the user can do.
    """

    rows: int
    columns: int
    doubts: tuple

    @property
    def is_possible(self) -> bool:
        """True if a sensor may have this size."""
        return max(self.rows, self.columns) <= MAX_SIDE


def measure_size(recordings, options: ReadingOptions) -> SensorSize:
    """The size of a sensor: the user's, the one in the files, or that of the events.

    Parameters
    ----------
    recordings : list of EventRecording
        Their coordinates are those of taxels, after squares of pixels were combined.
    options : ReadingOptions
    """
    size = []
    for axis, stated in enumerate((options.rows, options.columns)):
        extents = [int(coordinates.max()) + 1 for coordinates in _list_along(recordings, axis)]
        in_files = _find_size_in_files(recordings, axis, options.downsample)
        size.append(stated or max([1, *extents, in_files]))
    rows, columns = size
    return SensorSize(rows, columns, _list_doubts(recordings, size, options))


def _list_along(recordings, axis):
    """The rows (axis 0) or columns (axis 1) of the events of each recording."""
    return [(recording.y, recording.x)[axis] for recording in recordings]


def _find_size_in_files(recordings, axis, downsample):
    """Rows or columns of the sensor that the files state; 0 if they do not."""
    return max((divide_up(r.size[axis], downsample) for r in recordings if r.size), default=0)


def _list_doubts(recordings, size, options):
    """Recordings that alone make the sensor as large as it is read, and what the user can do."""
    doubts = []
    for axis, stated in enumerate((options.rows, options.columns)):
        if stated:
            continue
        in_files = _find_size_in_files(recordings, axis, options.downsample)
        strays = find_strays(_list_along(recordings, axis), in_files)
        if strays is None:
            continue
        letter, noun = AXES[axis]
        combined = " after data.downsample" if options.downsample > 1 else ""
        up_to = "" if strays.n_events == 1 else "up to "
        text = (
            f"{format_count(strays.n_events, 'event')} at {letter} = {up_to}{strays.highest}"
            f"{combined}, and all others have {letter} from 0 to {strays.size - 1}; the sensor is "
            f"read as {size[0]} rows x {size[1]} columns: correct this, or give the number of "
            f"{noun}, such as --set skin.{noun}={strays.size}"
        )
        doubts.append((strays.recordings, text))
    return tuple(doubts)


def require_possible(path, size: SensorSize, downsample: int):
    """Refuse a sensor with more rows or columns than any has.

    Raises
    ------
    UserError
    """
    if not size.is_possible:
        downsample_needed = divide_up(max(size.rows, size.columns), MAX_SIDE) * downsample
        raise UserError(
            f"{path}: the sensor has {size.rows} rows and {size.columns} columns, more than "
            f"{MAX_SIDE}; combine squares of pixels: --set data.downsample={downsample_needed}"
        )
