"""The network of the page, from a run or from a bundle, and its sensor."""

import re
from pathlib import Path

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from deploy.network.provenance import read_classes, read_positions
from pipeline.live import RECORD
from pipeline.recordings.sensor import Sensor, are_digits, is_st_mnist_sensor

# The bundle on events that comes with this package; ``make shipped-bundle`` makes it, from the
# settings of ``shipped.toml``.
SHIPPED = Path(__file__).with_name("bundle")


def find_sensor(bundle: Bundle) -> Sensor:
    """The sensor and the classes of a network.

    Raises
    ------
    UserError
        The network's input is neither the events of a sensor nor their image.
    """
    spec = bundle.spec
    is_image = spec.stimulus.is_static
    if len(spec.input_shape) != 3 or (not is_image and spec.input_shape[2] != 2):
        raise UserError(
            f"{bundle.path}: its input has the shape {spec.input_shape}; the page needs a network "
            "on images, or on ON and OFF events"
        )
    rows, columns, _ = spec.input_shape
    polarities = 1 if spec.provenance.polarities == 1 else 2
    return Sensor(rows, columns, polarities, classes=read_classes(spec))


def find_record_folder(bundle: Bundle, sensor: Sensor) -> str:
    """The default folder of recordings: a separate one for each data set.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    """
    if is_st_mnist_sensor(sensor.rows, sensor.columns, sensor.classes):
        return RECORD
    name = re.sub(r"[^\w-]+", "-", Path(find_name(bundle)).stem).strip("-")
    return f"{RECORD}-{name[:40]}" if name else f"{RECORD}-{sensor.rows}x{sensor.columns}"


def find_name(bundle: Bundle) -> str:
    """The name of the data set that a network was trained on."""
    return str(bundle.spec.provenance.source or "recordings of unknown origin")


def describe_for_page(bundle: Bundle, sensor: Sensor, folder, outdated: str | None = None) -> dict:
    """The page's description of its network, its sensor and the folder of recordings.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    folder : path-like
    outdated : str, optional
        The reason if the bundle is outdated.
    """
    positions = read_positions(bundle.spec)
    return {
        "folder": str(folder),
        "architecture": bundle.spec.architecture,
        "outdated": outdated,
        "trained_on": find_name(bundle),
        "simulated": bool(bundle.spec.provenance.simulated),
        "rows": sensor.rows,
        "columns": sensor.columns,
        "polarities": sensor.polarities,
        "classes": list(sensor.classes),
        "digits": are_digits(sensor.classes),
        "positions": None if positions is None else positions.tolist(),
    }
