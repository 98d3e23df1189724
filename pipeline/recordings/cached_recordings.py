"""Recordings that are kept in a cache: those of files are imported on first use.

The cache has some files for each set of recordings, which are keyed by the source's content.  The
columns of its events are files of their own, which are memory-mapped, so that only the parts in use
are read.
"""

import hashlib
import json
import re
from dataclasses import astuple
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import read_arrays, read_json, write_arrays, write_json
from pipeline.progress import progress
from pipeline.recordings.cache import find_cache_folder, map_column, write_column
from pipeline.recordings.events import EVENT_DTYPES, Events
from pipeline.recordings.files.listing import Listing, hash_content, hash_listing, list_source
from pipeline.recordings.files.messages import describe_reading
from pipeline.recordings.files.reading import read_source
from pipeline.recordings.interpretation.options import AS_FOUND, ReadingOptions
from pipeline.recordings.recordings import Recordings, Source
from pipeline.recordings.sensor import Sensor, TaxelMap
from pipeline.settings import Settings

# Version of the cache; increase it with any change of the stored data or of the reading.
CACHE_VERSION = 10

# Maximum number of bytes of a set of recordings, a hundred times that of the published one.
MAX_CACHE_BYTES = 1 << 34

DELETE = "delete it and repeat the command, which makes it again"


def make_reading_options(settings: Settings) -> ReadingOptions:
    """The settings of reading files."""
    data = settings.data
    return ReadingOptions(
        settings.skin.rows,
        settings.skin.columns,
        time_unit=data.time_unit,
        downsample=data.downsample,
        bin_ms=data.bin_ms,
        rise=data.rise,
    )


def import_recordings(
    source: Path,
    skip_bad: bool = False,
    jobs: int = 2,
    warn=None,
    reading: ReadingOptions = AS_FOUND,
) -> Recordings:
    """Recordings of files, read on first use and cached.

    Parameters
    ----------
    source : Path
        A zip or folder of recordings.
    skip_bad : bool
        True to leave out files that cannot be read instead of stopping.
    jobs : int
        Number of processes.
    warn : callable, optional
        Called with one line for each remark, warning, and file that was left out.
    reading : ReadingOptions

    Raises
    ------
    UserError
        The source cannot be read, or the cache is damaged.
    """
    listing = list_source(source, reading.labelled)
    # An import without the bad files must not be used as a complete import later, and refused
    # files are not in the hash.
    refused = [list(entry) for entry in listing.refused]
    options = (skip_bad, *astuple(reading), refused)
    path = find_cache_file("imported", source.name, hash_source(listing), *options)
    recordings = read_stored(path)
    if recordings is None:
        new_recordings = read_source(source, jobs, skip_bad, progress, reading)
        recordings = store_and_load_recordings(path, new_recordings)
    if warn is not None:
        for line in describe_reading(source, recordings):
            warn(line)
    return recordings


def hash_source(listing: Listing) -> str:
    """The content hash of a source, which is read again only if its files have changed."""
    path = find_cache_folder() / f"source-{hash_listing(listing)[:24]}.json"
    if path.exists():
        sha256 = read_json(path, DELETE).get("sha256")
        if isinstance(sha256, str) and re.fullmatch("[0-9a-f]{64}", sha256):
            return sha256
    sha256 = hash_content(listing)
    write_json(path, {"sha256": sha256})
    return sha256


def find_cache_file(*key) -> Path:
    """The file for recordings that are determined by some plain values."""
    name = hashlib.sha256(json.dumps([CACHE_VERSION, *key]).encode()).hexdigest()[:24]
    return find_cache_folder() / f"recordings-{name}.npz"


def _make_column_path(path, name):
    """The file of a column of the events of recordings."""
    return path.with_name(f"{path.stem}-{name}.npy")


def store_recordings(path, recordings: Recordings):
    """Save recordings; the file at ``path`` is written last, since it marks them as complete."""
    for name in EVENT_DTYPES:
        write_column(_make_column_path(path, name), getattr(recordings.events, name))
    source = recordings.source
    sensor = recordings.sensor
    taxels = recordings.taxels
    positions = np.empty((0, 2)) if taxels.positions is None else taxels.positions
    write_arrays(
        path,
        compress=False,  # loads faster than compressed arrays
        offsets=recordings.offsets,
        labels=recordings.labels,
        ids=np.array(recordings.ids, dtype=str),
        writers=recordings.writers,
        parts=np.array(recordings.parts, dtype=str),
        row=taxels.row,
        column=taxels.column,
        positions=positions,
        source=np.array([source.name, source.sha256, source.time_unit]),
        bins=np.array([source.bin_ms, source.rise]),
        remarks=np.array(source.remarks, dtype=str),
        warnings=np.array(source.warnings, dtype=str),
        simulated=np.array(source.simulated),
        written=np.array(source.written),
        left_out=np.array(source.left_out, dtype=str),
        size=np.array([sensor.rows, sensor.columns, sensor.polarities]),
        duration_s=np.array(sensor.duration_s),
        classes=np.array(sensor.classes, dtype=str),
    )


def store_and_load_recordings(path, new_recordings: Recordings) -> Recordings:
    """Save recordings, and load them from the files, so that they do not take memory."""
    store_recordings(path, new_recordings)
    recordings = read_stored(path)
    assert recordings is not None
    return recordings


def read_stored(path) -> Recordings | None:
    """Load recordings, or return None if the file does not exist.

    Raises
    ------
    UserError
        The file exists but is damaged.
    """
    if not path.exists():
        return None
    arrays = read_arrays(path, DELETE, MAX_CACHE_BYTES)
    of_events = [
        map_column(_make_column_path(path, name), dtype, DELETE)
        for name, dtype in EVENT_DTYPES.items()
    ]
    try:
        if {len(column) for column in of_events} != {int(arrays["offsets"][-1])}:
            raise ValueError("another number of events")
        name, sha256, time_unit = (str(text) for text in arrays["source"])
        bin_ms, rise = arrays["bins"].tolist()
        positions = arrays["positions"]
        rows, columns, polarities = arrays["size"]
        recordings = Recordings(
            events=Events(*of_events),
            offsets=arrays["offsets"],
            labels=arrays["labels"],
            ids=tuple(arrays["ids"].tolist()),
            writers=arrays["writers"],
            source=Source(
                name,
                sha256,
                simulated=bool(arrays["simulated"]),
                written=bool(arrays["written"]),
                left_out=tuple(arrays["left_out"].tolist()),
                time_unit=time_unit,
                bin_ms=bin_ms,
                rise=int(rise),
                remarks=tuple(arrays["remarks"].tolist()),
                warnings=tuple(arrays["warnings"].tolist()),
            ),
            taxels=TaxelMap(arrays["row"], arrays["column"], positions if len(positions) else None),
            sensor=Sensor(
                rows=int(rows),
                columns=int(columns),
                polarities=int(polarities),
                duration_s=float(arrays["duration_s"]),
                classes=tuple(arrays["classes"].tolist()),
            ),
            parts=tuple(arrays["parts"].tolist()),
        )
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path}: damaged cache ({error}); {DELETE}") from error
    return recordings
