"""The interpretation of recordings: one sensor, and its events, made from their files."""

from dataclasses import dataclass

from deploy.arithmetic import divide_up
from deploy.errors import UserError
from pipeline.recordings.sensor import (
    DIGITS,
    GRID,
    N_TAXELS,
    Sensor,
    TaxelMap,
)

# How messages name the options for the size of the sensor.
GIVE_SIZE = "--set skin.rows=... --set skin.columns=..."


@dataclass(frozen=True)
class Interpretation:
    """Recordings of one sensor.

    Attributes
    ----------
    kept : list of int
        Indices of the recordings that fit.
    events : list of Events
        Events of each recording that is kept.
    refused : dict of int to str
        Index of each recording that does not fit, and the reason.
    taxels : TaxelMap
    rows, columns : int
    time_unit : str
        Unit in which the times of files of events were read.
    duration_s : float
        Duration that the files state; 0 if they do not.
    bin_ms : float
        Width of a bin of arrays of counts; 0 for other files.
    rise : int
        Channel of rising pressure of arrays of counts.
    remarks : tuple of str
        What the user should know about how the files were read.
    doubts : tuple of (tuple of int, str)
        Indices of recordings that may be damaged, and what follows from them.
    """

    kept: list
    events: list
    refused: dict
    taxels: TaxelMap
    rows: int
    columns: int
    time_unit: str = ""
    duration_s: float = 0.0
    bin_ms: float = 0.0
    rise: int = 0
    remarks: tuple = ()
    doubts: tuple = ()

    def make_sensor(self, classes: tuple) -> Sensor:
        """The sensor, with ST-MNIST's classes and duration if the recordings are of its format.

        Parameters
        ----------
        classes : tuple of str
            Names of the classes, in the order of their labels.
        """
        is_full = len(self.taxels) == N_TAXELS and self.rows == self.columns == GRID
        is_numbered = not self.time_unit and not self.bin_ms
        if is_full and set(classes) <= set(DIGITS) and is_numbered:
            return Sensor(self.rows, self.columns)
        latest_ns = max((int(events.time_ns[-1]) for events in self.events), default=0)
        latest_ns = max(latest_ns, round(self.duration_s * 1e9))
        return Sensor(
            self.rows,
            self.columns,
            polarities=1 if all((events.polarity > 0).all() for events in self.events) else 2,
            duration_s=max(divide_up(latest_ns, 100_000_000), 1) / 10,  # up to the next tenth
            classes=classes,
        )


def renumber_doubts(doubts, numbers) -> tuple:
    """Doubts about selected recordings, by the numbers of these recordings among all.

    Parameters
    ----------
    doubts : tuple of (tuple of int, str)
        See :attr:`Interpretation.doubts`.
    numbers : list of int
        Number of each selected recording among all.
    """
    renumbered = []
    for indices, text in doubts:
        renumbered.append((tuple(numbers[index] for index in indices), text))
    return tuple(renumbered)


def refuse_two_sensors(path, properties: dict, remedy: str = ""):
    """Refuse a published split whose parts are of different sensors.

    Parameters
    ----------
    path : path-like
        Path of the source.
    properties : dict of str to str
        A property in which the parts differ, by part.
    remedy : str
        Another remedy, after the usual one.

    Raises
    ------
    UserError
    """
    listed = ", ".join(f"{part} has {text}" for part, text in sorted(properties.items())[::-1])
    raise UserError(
        f"{path}: train and test are of different sensors: {listed}; give recordings of one "
        f"sensor{remedy}"
    )
