"""The network of the page, from a run or from a bundle, and its sensor."""

from __future__ import annotations

import re
from pathlib import Path

from deploy.check.bundle import Bundle, read_bundle
from deploy.errors import UserError
from deploy.files import read_json
from deploy.network.stimulus import EventFrames
from pipeline.data.dataset import positions_of
from pipeline.data.events import Sensor, are_digits, is_written
from pipeline.run import RunFolder
from pipeline.settings import Image, read_settings

# The bundle on events that comes with this package; ``make shipped-bundle`` makes it, from the
# settings of ``shipped.toml``.
SHIPPED = Path(__file__).with_name("bundle")

# Folder for recordings of digits; of other data the start of its name.
RECORD = "written"


def network_of_bundle(folder: Path) -> tuple | None:
    """The bundle in a copied folder, and its conversion of events to images.

    Returns
    -------
    (Bundle, Image) or None
        None if there is no bundle.

    Raises
    ------
    UserError
        The bundle is damaged.
    """
    if not (folder / "MANIFEST.json").exists():
        return None
    return _with_images(read_bundle(folder), Image())


def network_of_run(run: RunFolder) -> tuple | None:
    """As :func:`network_of_bundle`, for a run; None if its bundle has not been made yet."""
    if not run.bundle.exists():
        return None
    known = run.experiment.exists()
    otherwise = read_settings(run.experiment).image if known else Image()
    return _with_images(read_bundle(run.bundle), otherwise)


def _with_images(bundle, otherwise):
    """Add the conversion to images in the bundle; earlier bundles do not have it."""
    said = bundle.spec.provenance.get("image")
    try:
        return bundle, otherwise if said is None else Image(**said)
    except TypeError as error:
        raise UserError(
            f"{bundle.path}: the conversion of events to its images is unknown ({error})"
        ) from error


def facts_of_run(run: RunFolder) -> dict:
    """Facts about the recordings of a run; none if the folder is not a run."""
    try:
        facts = read_json(run.dataset, "") if run.experiment.exists() else {}
    except UserError:
        return {}
    return facts if isinstance(facts.get("sensor"), dict) else {}


def sensor_of(bundle: Bundle, facts: dict) -> Sensor:
    """The sensor and the classes of a network.

    Parameters
    ----------
    bundle : Bundle
    facts : dict
        Facts about its run's recordings (:func:`pipeline.data.statistics.facts_of`); empty without
        a run.

    Raises
    ------
    UserError
        The network's input is neither the events of a sensor nor their image.
    """
    spec = bundle.spec
    on_events = isinstance(spec.stimulus, EventFrames)
    if len(spec.input_shape) != 3 or spec.input_shape[2] != (2 if on_events else 1):
        raise UserError(
            f"{bundle.path}: its input has the shape {spec.input_shape}; the page needs a network "
            "on images with one channel, or on ON and OFF events"
        )
    rows, columns, _ = spec.input_shape
    polarities = facts.get("sensor", {}).get("polarities")
    if polarities not in (1, 2):
        polarities = 1 if on_events and not bundle.checks.inputs[..., 1].any() else 2
    return Sensor(rows, columns, polarities, classes=_classes(spec))


def _classes(spec):
    """Names of the network's classes, or their numbers if it has no names."""
    n = spec.layers[-1].size
    said = spec.provenance.get("classes")
    are_names = isinstance(said, list) and all(isinstance(name, str) for name in said)
    return tuple(said) if are_names and len(set(said)) == n else tuple(map(str, range(n)))


def record_folder(bundle: Bundle, sensor: Sensor) -> str:
    """The default folder of recordings: a separate one for each data set.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    """
    if is_written(sensor.rows, sensor.columns, sensor.classes):
        return RECORD
    name = re.sub(r"[^\w-]+", "-", Path(name_of(bundle)).stem).strip("-")
    return f"{RECORD}-{name[:40]}" if name else f"{RECORD}-{sensor.rows}x{sensor.columns}"


def name_of(bundle: Bundle) -> str:
    """The name of the data set that a network was trained on."""
    return str(bundle.spec.provenance.get("source", "recordings of unknown origin"))


def about(bundle: Bundle, sensor: Sensor, folder, outdated: str | None = None) -> dict:
    """The page's description of its network, its sensor and the folder of recordings.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    folder : path-like
    outdated : str, optional
        The reason if the bundle is outdated.
    """
    positions = positions_of(bundle.spec)
    return {
        "folder": str(folder),
        "architecture": bundle.spec.architecture,
        "outdated": outdated,
        "bundle": bundle.id[:12],
        "trained_on": name_of(bundle),
        "simulated": bool(bundle.spec.provenance.get("simulated", False)),
        "rows": sensor.rows,
        "columns": sensor.columns,
        "polarities": sensor.polarities,
        "classes": list(sensor.classes),
        "digits": are_digits(sensor.classes),
        "positions": None if positions is None else positions.tolist(),
    }
