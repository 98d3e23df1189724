"""Recordings on disk, ready to load: imported or simulated once, keyed by the source's content."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import read_arrays, read_json, write_arrays, write_json
from pipeline.data.events import (
    EVENT_DTYPES,
    Events,
    Recordings,
    Sensor,
    Source,
    TaxelMap,
)
from pipeline.data.stored import problem_with

_SHA256 = re.compile("[0-9a-f]{64}")

FORMAT = 5
"""Version of the format; increase it with any change of the stored data or of the reading."""

LARGEST = 1 << 34
"""Maximum number of bytes of a set of recordings, a hundred times that of the published one."""


def folder() -> Path:
    """The folder of the cache: ``$STMNIST_CACHE``, or ``stmnist`` in the user's cache folder."""
    if os.environ.get("STMNIST_CACHE"):  # if empty, it is not set
        return Path(os.environ["STMNIST_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stmnist"


def key_of(*parts) -> str:
    """A file name for recordings that are determined by some plain values."""
    return hashlib.sha256(json.dumps([FORMAT, *parts]).encode()).hexdigest()[:24]


def store(key: str, recordings: Recordings):
    """Save recordings under a key."""
    source, sensor = recordings.source, recordings.sensor
    write_arrays(
        _path(key),
        compress=False,  # loads faster than compressed arrays
        **{name: getattr(recordings.events, name) for name in EVENT_DTYPES},
        offsets=recordings.offsets,
        labels=recordings.labels,
        ids=np.array(recordings.ids, dtype=str),
        writers=recordings.writers,
        row=recordings.taxels.row,
        column=recordings.taxels.column,
        source=np.array([source.name, source.sha256, source.time_unit]),
        simulated=np.array(source.simulated),
        written=np.array(source.written),
        left_out=np.array(source.left_out, dtype=str),
        size=np.array([sensor.rows, sensor.columns, sensor.polarities]),
        duration_s=np.array(sensor.duration_s),
        classes=np.array(sensor.classes, dtype=str),
    )


def load(key: str) -> Recordings | None:
    """Load recordings, or return None if the key does not exist.

    Raises
    ------
    UserError
        The file exists but is damaged.
    """
    path = _path(key)
    if not path.exists():
        return None
    remedy = "delete it and run the command again to make it again"
    arrays = read_arrays(path, remedy, LARGEST)
    try:
        if problem := problem_with(arrays):
            raise UserError(f"{path}: damaged cache ({problem}); {remedy}")
        name, sha256, time_unit = (str(text) for text in arrays["source"])
        recordings = Recordings(
            events=Events(*(arrays[column] for column in EVENT_DTYPES)),
            offsets=arrays["offsets"],
            labels=arrays["labels"],
            ids=tuple(arrays["ids"].tolist()),
            writers=arrays["writers"],
            source=Source(
                name,
                sha256,
                bool(arrays["simulated"]),
                bool(arrays["written"]),
                tuple(arrays["left_out"].tolist()),
                time_unit,
            ),
            taxels=TaxelMap(arrays["row"], arrays["column"]),
            sensor=Sensor(
                *(int(n) for n in arrays["size"]),
                float(arrays["duration_s"]),
                tuple(arrays["classes"].tolist()),
            ),
        )
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path}: damaged cache ({error}); {remedy}") from error
    return recordings


def remember(fingerprint: str, sha256: str):
    """Store the content hash of a source, so that the source need not be read again."""
    write_json(folder() / f"source-{fingerprint[:24]}.json", {"sha256": sha256})


def recall(fingerprint: str) -> str | None:
    """The stored content hash of a source, or None."""
    path = folder() / f"source-{fingerprint[:24]}.json"
    if not path.exists():
        return None
    sha256 = read_json(path, "delete it and run the command again").get("sha256")
    return sha256 if isinstance(sha256, str) and _SHA256.fullmatch(sha256) else None


def _path(key):
    return folder() / f"recordings-{key}.npz"
