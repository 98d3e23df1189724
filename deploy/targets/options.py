"""Options of targets: fields of a dataclass, which both command lines offer and check."""

from dataclasses import asdict, dataclass, field, fields
from typing import ClassVar, Optional

from ..errors import UserError

# Seconds up to which the wait between two attempts is doubled.
MAX_WAIT_S = 600.0


def option(default, help_text, minimum=None, maximum=None):
    """A field with its help on both command lines, and its bounds; None means no bound."""
    return field(default=default, metadata={"help": help_text, "range": (minimum, maximum)})


def format_flag(name: str) -> str:
    """An option on a command line, by the name of its field."""
    return "--" + name.replace("_", "-")


@dataclass(frozen=True)
class Options:
    """Base class of the options of a target: a frozen dataclass whose fields are :func:`option`.

    Attributes
    ----------
    changes_outputs : bool
        True if a target with other options gives other outputs: a check then records them, and a
        check with other options does not continue it.

    Raises
    ------
    UserError
        A value is out of its range.
    """

    changes_outputs: ClassVar[bool] = True

    def __post_init__(self):
        for entry in fields(self):
            minimum, maximum = entry.metadata["range"]
            value = getattr(self, entry.name)
            flag = format_flag(entry.name)
            # `not` with the allowed comparison also refuses NaN
            if minimum is not None and not value >= minimum:
                raise UserError(f"{flag} must be at least {minimum:g}")
            if maximum is not None and not value <= maximum:
                raise UserError(f"{flag} must be at most {maximum:g}")

    def list_output_values(self) -> dict:
        """The values that change the outputs, by the names of the options.

        A default is not among them: a check without options has the same result.
        """
        if not self.changes_outputs:
            return {}
        defaults = {entry.name: entry.default for entry in fields(self)}
        return {name: value for name, value in asdict(self).items() if value != defaults[name]}


@dataclass(frozen=True)
class BoardOptions(Options):
    """Options of the board: which one, how many attempts, and what to measure.

    Attributes
    ----------
    board : str or None
        Name of a board; None leaves the choice to the cluster.
    partition : str or None
        SLURM partition; None if the board is attached to this host.
    chips : int
        Maximum number of chips for the network.
    attempts : int
        Maximum number of attempts per stream.  NengoLoihi tries to connect three times in each.
    wait : float
        Seconds before the second attempt, doubled for each further one up to `MAX_WAIT_S`.
    energy : bool
        Measure power.
    timeout : float
        Time limit in seconds for the connection and for the run of a stream, each.
    """

    changes_outputs: ClassVar[bool] = False

    board: Optional[str] = option(None, "Name of a board (default: the cluster's choice).")
    partition: Optional[str] = option(None, "SLURM partition (default: a board of this host).")
    chips: int = option(1, "Largest number of chips to use.", 1, 10_000)
    attempts: int = option(3, "Largest number of attempts for each stream of samples.", 1, 1000)
    wait: float = option(
        10.0,
        "Seconds before the second attempt, doubled for each further one up to ten minutes.",
        0,
        86_400,
    )
    timeout: float = option(
        1800.0, "Seconds after which a stream that hangs is abandoned.", 1e-3, 864_000
    )
    energy: bool = option(False, "Measure power if the board can.")
