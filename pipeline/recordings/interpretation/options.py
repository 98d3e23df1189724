"""Properties of files that the user specifies."""

from dataclasses import dataclass

# Value of ReadingOptions.rise that leaves the choice of the channel to the interpretation.
AUTOMATIC_RISE = -1


@dataclass(frozen=True)
class ReadingOptions:
    """Properties of files that the user specifies instead of having them detected.

    Attributes
    ----------
    rows, columns : int
        Size of the sensor, after :attr:`downsample`; 0: detected.
    time_unit : str
        Unit in files of events, one of :data:`pipeline.recordings.formats.recording.UNITS`;
        empty: inferred.
    downsample : int
        Side of the square of pixels of a file of events that becomes one taxel.
    usual_unit : str
        Unit of similar recordings, such as those that a network was trained on, for files of
        events that do not have theirs, if :attr:`time_unit` is empty.
    bin_ms : float
        Width of a bin in arrays of counts, in milliseconds.
    rise : int
        Channel of rising pressure in arrays of counts; -1: 1 on ST-MNIST's grid, else 0.
    labelled : bool
        False if recordings need not be in folders of classes; the source may be one file then.
    """

    rows: int = 0
    columns: int = 0
    time_unit: str = ""
    downsample: int = 1
    usual_unit: str = ""
    bin_ms: float = 20.0
    rise: int = AUTOMATIC_RISE
    labelled: bool = True


AS_FOUND = ReadingOptions()
